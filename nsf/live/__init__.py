"""A deployed reduced model, live: it runs in any case, is shown in a browser, and is streamed.

`model` runs and decodes, `player` chooses the run and the frame to show, `feeds` makes messages of it, and
`server` sends them to the page in `web`. `publish` puts the model itself into that page.
"""

#: Hosts that this machine alone reaches.
LOOPBACK = ("127.0.0.1", "localhost", "::1")
