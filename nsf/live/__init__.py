"""A deployed reduced model under one's hands: run at any parameter value, looked at.

`model` runs and decodes, `player` decides what is shown; `page` shows it in viser.
"""
