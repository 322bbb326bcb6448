"""Ask the scene-reasoning service about a robot's detections."""
