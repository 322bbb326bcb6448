"""Training: turn scenes into versioned artifacts. The service never imports this package."""
