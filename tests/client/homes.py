"""A stand-in for the client of a home, and frames of detections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scene_client import schemas

MODEL = {"name": "m", "version": "1.0.0", "variant": "rbm", "digest": "0" * 64}
COMMON: dict[str, Any] = {"model": MODEL, "request_id": "r"}


class FakeClient:
    """Answers by labels. `error` is raised instead of an answer."""

    def __init__(self) -> None:
        self.odd: set[str] = set()
        self.misplaced: set[str] = set()
        self.unreal: set[str] = set()
        self.types: list[tuple[str, float]] = [("kitchen", 0.9), ("bathroom", 0.1)]
        self.room_types: set[str] = {"kitchen", "bathroom"}
        self.error: Exception | None = None
        self.asked: list[tuple[str, Any, dict[str, Any]]] = []

    def questions(self, name: str) -> list[dict[str, Any]]:
        return [fields | {"objects": objects} for one, objects, fields in self.asked if one == name]

    def _ask(self, name: str, objects: Any, fields: dict[str, Any]) -> None:
        self.asked.append((name, objects, fields))
        if self.error is not None:
            raise self.error

    def outliers(self, objects: Any, **fields: Any) -> schemas.OutliersAnswer:
        self._ask("outliers", objects, fields)
        room = fields.get("room_type")
        entries = [
            {
                "object": one["id"],
                "label": one["label"],
                "probability": 0.9 if one["label"] in self.odd else 0.1,
                "is_outlier": one["label"] in self.odd,
                "real": 0.2 if one["label"] in self.unreal else 1.0,
                "reason": "misdetection" if one["label"] in self.unreal else None,
            }
            for one in objects
        ]
        wrong = [
            {"subject": one["id"], "relation": "on-top", "object": "floor", "probability": 0.8,
             "is_misplaced": True, "reason": "on-floor", "moved": one["id"]}
            for one in objects
            if one["label"] in self.misplaced
        ]  # fmt: skip
        ignored = [] if room is None or room in self.room_types else [room]
        answer = COMMON | {"outliers": entries, "misplaced": wrong, "ignored": ignored}
        return schemas.OutliersAnswer.model_validate(answer)

    def rooms(self, objects: Any, **fields: Any) -> schemas.RoomsAnswer:
        self._ask("rooms", objects, fields)
        types = [{"room_type": name, "probability": p} for name, p in self.types]
        return schemas.RoomsAnswer.model_validate(COMMON | {"room_types": types})

    def missing(self, objects: Any, **fields: Any) -> schemas.MissingAnswer:
        self._ask("missing", objects, fields)
        return schemas.MissingAnswer.model_validate(COMMON | {"missing": []})

    def where(self, label: str, rooms: Any, **fields: Any) -> schemas.WhereAnswer:
        self._ask("where", rooms, fields)
        answer = COMMON | {"label": label, "places": [], "rooms": [], "not_here": 1.0}
        return schemas.WhereAnswer.model_validate(answer)


def thing(label: str, x: float, y: float = 0.0, z: float = 0.5, **more: Any) -> dict[str, Any]:
    """A detection of a box of half a metre."""
    place: Sequence[float] = [x, y, z]
    size = [0.5, 0.5, 0.5]
    return {"label": label, "confidence": 0.9, "position": place, "size": size, **more}
