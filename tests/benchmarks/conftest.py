"""`rbms` compiles with torch.jit as it is imported, which torch calls deprecated."""

import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    import rbms.bernoulli_bernoulli.classes  # noqa: F401
