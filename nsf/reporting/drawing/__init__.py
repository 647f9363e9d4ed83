"""Charts: data in, figures out."""
