"""A deployed reduced model, live: it runs in any case, is shown in a browser, and is streamed.

`model` runs and decodes, `player` chooses the run and the frame to show, `page` shows it in viser, and
`server` streams it.
"""

#: Hosts that this machine alone reaches.
LOOPBACK = ("127.0.0.1", "localhost", "::1")
