"""What a report says in words and numbers, and how each format writes it."""
