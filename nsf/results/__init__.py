"""The table of results, and the charts and pages made of it."""
