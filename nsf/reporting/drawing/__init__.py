"""Charts and pictures: data in, figures out."""
