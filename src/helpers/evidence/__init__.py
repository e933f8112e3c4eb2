"""Beyond the paper's own runs: the inferred settings, the runs behind the claims, the limits and the alternatives."""
