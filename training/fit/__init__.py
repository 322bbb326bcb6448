"""Training of one configuration: objectives, the trainer, statistics and calibration."""
