"""From requests to answers: reading scenes, holding models, asking them. Knows nothing of HTTP."""
