"""Training runs: configurations, scenes, a run's folder, live curves and publication."""
