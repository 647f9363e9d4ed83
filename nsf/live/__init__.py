"""A deployed reduced model under one's hands: run at any parameter value, looked at, and streamed.

`model` runs and decodes, `player` decides what is shown; `page` shows it in viser, `server` streams it.
"""

#: Hosts that only this machine reaches.
LOOPBACK = ("127.0.0.1", "localhost", "::1")
