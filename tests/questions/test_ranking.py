"""The best of many against sorting them all."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.questions.ranking import best

# Few different values, so that ties are the rule.
VALUES = st.lists(st.tuples(st.integers(-3, 3), st.booleans()), max_size=60)


@given(VALUES, st.integers(1, 70))
@settings(max_examples=300)
def test_largest_first_and_ties_by_position(entries, count):
    values = np.array([value for value, _ in entries], dtype=np.float32)
    usable = np.array([choice for _, choice in entries], dtype=np.bool_)
    expected = [k for k in np.argsort(-values, kind="stable").tolist() if usable[k]]
    assert best(values, usable, count).tolist() == expected[:count]
