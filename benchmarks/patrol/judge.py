"""Drive a `Home` through a patrol, and count its right and wrong alarms."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Literal

from benchmarks.patrol.robot import FOV, REACH, Detection, World
from scene_client import Client, Home, Settings

Situation = Literal["full", "poses", "labels"]
THINGS = ("out-of-place", "misplaced", "misdetection")


@dataclass
class Row:
    """One second of a patrol. An alarm is a pair of the true thing, or a track, and its kind.

    `is_known` is true from the first detection in the room on.
    """

    lap: int
    room: str
    visible: set[str]
    is_known: bool
    said: str | None
    alarms: set[tuple[str, str]]
    labels: dict[str, str]
    events: list[Any]


@dataclass
class Counts:
    """Sums over patrols."""

    seconds: int = 0
    right: int = 0
    wrong: int = 0
    onsets: Counter[str] = field(default_factory=Counter)
    changes: int = 0
    known: int = 0
    room_right: int = 0
    room_changes: int = 0
    found: list[int] = field(default_factory=list)
    in_view: list[int] = field(default_factory=list)
    events: Counter[str] = field(default_factory=Counter)
    worst: Counter[str] = field(default_factory=Counter)

    @property
    def minutes(self) -> float:
        return self.seconds / 60

    def figures(self) -> dict[str, Any]:
        """Return the printed figures."""
        minutes = max(self.minutes, 1e-9)
        return {
            "alarms right": round(self.right / max(1, self.right + self.wrong), 3),
            "wrong onsets/min real": round(self.onsets["real"] / minutes, 3),
            "ghost": round(self.onsets["ghost"] / minutes, 3),
            "place": round(self.onsets["place"] / minutes, 3),
            "on/off/min": round(self.changes / minutes, 3),
            "found": "".join(map(str, self.found)),
            "s in view": (max(self.in_view, default=0), median(self.in_view or [0])),
            "room right": round(self.room_right / max(1, self.known), 3),
            "room changes/min": round(self.room_changes / minutes, 3),
        }


def drive(
    client: Client, world: World, situation: Situation, settings: Settings | None = None
) -> list[Row]:
    """Return the rows of one patrol."""
    names = {room: f"area {n}" for n, room in enumerate(world.flat.rooms)}
    polygons = {
        names[room]: [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        for room, (x0, y0, x1, y1) in world.flat.rooms.items()
    }
    home = Home(
        client,
        polygons if situation != "labels" else None,
        view=(FOV, REACH) if situation == "full" else None,
        room_candidates=sorted(set(world.types.values())),
        settings=settings,
    )
    true: dict[str, Counter[str | None]] = defaultdict(Counter)
    rows, known = [], set()
    for second, (lap, room, pose, seen) in enumerate(world.frames):
        is_placed = situation != "labels"
        events = home.update(
            [_fields(one, is_placed) for one in seen],
            pose if is_placed else None,
            1e9 + second,
            room=None if is_placed else names[room],
        )
        for name, one in zip(home.matched, seen, strict=True):
            true[name][one.true] += 1
        alarms: set[tuple[str, str]] = set()
        labels: dict[str, str] = {}
        for alarm in home.alarms:
            if alarm.room != names[room]:
                continue
            ((thing, hits),) = true[alarm.id or ""].most_common(1)
            key = thing if thing is not None and hits else f"ghost {alarm.id}"
            alarms.add((key, alarm.kind))
            labels[key] = alarm.label or ""
        visible = {one.id for one in world.visible(room, pose)}
        known |= {room} if seen else set()
        row = Row(lap, room, visible, room in known, home.room_type(), alarms, labels, events)
        rows.append(row)
    return rows


def _fields(one: Detection, is_placed: bool) -> dict[str, Any]:
    fields: dict[str, Any] = {"label": one.label, "confidence": one.confidence}
    if is_placed:
        fields |= {"position": list(one.place), "size": list(one.size)}
    if one.other is not None:
        rest = (1 - one.confidence) * 0.8
        fields["alternatives"] = [{"label": one.other, "confidence": max(0.01, rest)}]
    return fields


def count(rows: Iterable[Row], world: World, sums: Counts) -> None:
    """Add one patrol to the sums."""
    intruders = {one.id for one in world.flat.things if one.is_intruder}
    seen, found = Counter[str](), dict[str, int]()
    before: dict[str, set[tuple[str, str]]] = defaultdict(set)
    last: Row | None = None
    for row in rows:
        sums.seconds += 1
        seen.update(intruders & row.visible)
        for key, kind in row.alarms:
            if kind == "misdetection":
                continue
            if key in intruders:
                found.setdefault(key, seen[key])
            if kind == "out-of-place":
                sums.right += key in intruders
                sums.wrong += key not in intruders
        changed = row.alarms ^ before[row.room]
        for key, kind in changed:
            is_on, is_first = (key, kind) in row.alarms, key in found and seen[key] == found[key]
            if kind == "out-of-place" and not (key in intruders and is_on and is_first):
                sums.changes += 1
            if is_on and kind != "misdetection" and key not in intruders:
                group = "ghost" if key.startswith("ghost ") else "real"
                sums.onsets["place" if kind == "misplaced" else group] += 1
                sums.worst[f"{kind} {key.split('#')[0]} as {row.labels[key]} in {row.room}"] += 1
        before[row.room] = row.alarms
        if row.is_known:
            sums.known += 1
            sums.room_right += row.said == world.types[row.room]
            if last is not None and last.room == row.room:
                sums.room_changes += last.said != row.said
            last = row
        sums.events.update(event.kind for event in row.events)
    sums.found.append(len(found))
    sums.in_view += found.values()
