"""The serving layer, without HTTP: it reads scenes, loads models and answers questions."""
