"""Training: from scenes to versioned artifacts. The service never imports it."""
