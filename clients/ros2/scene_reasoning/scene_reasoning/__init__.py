"""A robot's detections, put to the scene-reasoning service."""
