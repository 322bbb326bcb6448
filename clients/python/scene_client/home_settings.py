"""The settings of a home, and values that change only after a while."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scene_client import schemas


@dataclass(frozen=True)
class Settings:
    """The settings of a `Home`. The defaults are those of the best patrols (docs/moving.md)."""

    hit_rate: float = 0.7  # probability that the detector reports a thing that the frame shows
    false_rate: float = 0.02  # probability of a wrong detection at the place of an absent thing
    prior: float = 0.1  # probability that the first detection at a place shows a thing
    confirm: float = 0.9  # probability of existence from which a thing is present
    gate: float = 0.3  # metres between detections of one small thing; more for a large thing
    look: float = 0.5  # seconds between independent looks; faster frames count in proportion
    hold: float = 3.0  # seconds in view until an alarm is raised or cleared
    answers: int = 3  # looks until an alarm is raised or cleared
    room_hold: float = 5.0  # seconds until the type of a room is settled, or changes
    pause: float = 0.5  # seconds between questions
    step: float = 0.1  # change of a probability, or metres of a position, that needs an answer
    sensitivity: schemas.Sensitivity = "medium"  # rate of alarms of the service
    timeout: float = 1.0  # maximum seconds of a question
    save_every: float = 10.0  # seconds between writes of the file

    def __post_init__(self) -> None:
        shares = (self.hit_rate, self.false_rate, self.prior, self.confirm)
        spans = (self.gate, self.look, self.hold, self.room_hold, self.timeout)
        if not all(0 < one < 1 for one in shares) or self.false_rate >= self.hit_rate:
            raise ValueError(
                "hit_rate, prior and confirm must be between 0 and 1, above false_rate"
            )
        if not all(0 < one < math.inf for one in spans) or self.answers < 1:
            raise ValueError("gate, look, hold, room_hold, timeout and answers must be positive")


@dataclass
class Latch:
    """A value that changes only after a while.

    The steps for a candidate must be ahead of all other steps by 1 (majority vote of Boyer and
    Moore). `since` is the time of the candidate's first step.
    """

    value: str | None = None
    candidate: str | None = None
    level: float = 0.0
    since: float = 0.0

    def update(self, value: str | None, now: float, step: float) -> bool:
        """Count one step for a value. Return whether the latch changes to this value."""
        if value == self.value or (value != self.candidate and self.level > step / 2):
            self.level = max(0.0, self.level - step)
            return False
        if value != self.candidate or self.level == 0:
            self.candidate, self.level, self.since = value, 0.0, now
        self.level += step
        if self.level < 1 - 1e-9:
            return False
        self.value, self.candidate, self.level = value, None, 0.0
        return True
