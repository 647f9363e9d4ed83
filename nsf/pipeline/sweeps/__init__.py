"""Many chains: the jobs of a sweep, experiments, and a search for good values."""
