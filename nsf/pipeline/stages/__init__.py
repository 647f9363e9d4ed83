"""The work of each stage: trajectories, manifold, operators, reduced runs, errors and costs."""
