"""The serving layer: it reads scenes, holds the loaded models and answers questions, without HTTP."""
