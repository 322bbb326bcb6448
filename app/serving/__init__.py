"""The serving layer reads scenes, loads models and answers questions. It does not use HTTP."""
