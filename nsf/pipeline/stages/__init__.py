"""The work of each stage: trajectories, manifold, recurrence, reduced runs, errors and costs."""
