"""All runs there are: in the terminal, and as a page that sorts and filters."""
