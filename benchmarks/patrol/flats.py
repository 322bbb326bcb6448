"""Random flats: rooms, usual things at usual places, and five things out of place.

The tables are from common knowledge. They are not derived from training data.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Final

Vector = tuple[float, float, float]

SIZES: Final[dict[str, Vector]] = {
    "air freshener": (0.07, 0.07, 0.2), "alarm clock": (0.12, 0.08, 0.1),
    "armchair": (0.85, 0.85, 0.9), "backpack": (0.3, 0.2, 0.45), "basket": (0.4, 0.3, 0.3),
    "bathtub": (1.7, 0.75, 0.6), "bed": (2.0, 1.5, 0.55), "bench": (1.1, 0.4, 0.45),
    "blanket": (1.2, 1.0, 0.1), "book": (0.15, 0.22, 0.03), "bookshelf": (0.9, 0.35, 1.9),
    "bowl": (0.17, 0.17, 0.08), "box": (0.4, 0.3, 0.3), "broom": (0.3, 0.1, 1.3),
    "bucket": (0.3, 0.3, 0.3), "cabinet": (0.8, 0.45, 0.9), "chair": (0.45, 0.45, 0.9),
    "clothes dryer": (0.6, 0.6, 0.85), "coat": (0.5, 0.15, 1.0), "coat rack": (0.4, 0.4, 1.7),
    "coffee machine": (0.25, 0.3, 0.35), "coffee table": (1.0, 0.6, 0.42),
    "computer": (0.2, 0.45, 0.45), "counter": (2.2, 0.6, 0.9), "crib": (1.3, 0.7, 0.9),
    "cup": (0.08, 0.08, 0.1), "curtain": (1.3, 0.1, 2.1), "cutting board": (0.4, 0.25, 0.02),
    "desk": (1.4, 0.7, 0.74), "detergent": (0.12, 0.1, 0.3), "dishwasher": (0.6, 0.6, 0.85),
    "doll": (0.15, 0.1, 0.3), "dresser": (1.1, 0.5, 0.9), "drying rack": (1.2, 0.5, 0.9),
    "floor lamp": (0.35, 0.35, 1.6), "fork": (0.2, 0.03, 0.02), "fridge": (0.65, 0.65, 1.8),
    "fruit bowl": (0.28, 0.28, 0.12), "hair dryer": (0.2, 0.1, 0.2), "hammer": (0.3, 0.12, 0.04),
    "hat": (0.3, 0.25, 0.12), "iron": (0.25, 0.12, 0.14), "ironing board": (1.2, 0.35, 0.9),
    "kettle": (0.2, 0.2, 0.25), "keyboard": (0.45, 0.15, 0.03), "lamp": (0.25, 0.25, 0.45),
    "laptop": (0.33, 0.24, 0.22), "laundry basket": (0.45, 0.35, 0.5),
    "microwave": (0.5, 0.36, 0.3), "mirror": (0.6, 0.05, 0.8), "monitor": (0.55, 0.2, 0.42),
    "mouse": (0.07, 0.12, 0.04),
    "nightstand": (0.45, 0.4, 0.55), "notebook": (0.2, 0.28, 0.02), "oven": (0.6, 0.58, 0.6),
    "pan": (0.3, 0.3, 0.07), "picture": (0.6, 0.05, 0.5), "pillow": (0.5, 0.35, 0.15),
    "plant": (0.4, 0.4, 0.9), "plate": (0.25, 0.25, 0.03), "pot": (0.25, 0.25, 0.18),
    "printer": (0.45, 0.4, 0.25), "razor": (0.05, 0.04, 0.15), "remote control": (0.05, 0.17, 0.03),
    "shampoo": (0.07, 0.07, 0.22), "shoe": (0.1, 0.28, 0.12), "shoe rack": (0.8, 0.3, 0.5),
    "shower": (0.9, 0.9, 2.0), "sideboard": (1.6, 0.45, 0.85), "sink": (0.55, 0.45, 0.2),
    "sofa": (2.0, 0.9, 0.8), "stove": (0.6, 0.6, 0.9), "stuffed animal": (0.25, 0.2, 0.3),
    "table": (1.4, 0.85, 0.75), "telephone": (0.18, 0.2, 0.08), "toaster": (0.3, 0.2, 0.2),
    "toilet": (0.4, 0.65, 0.8), "toilet brush": (0.1, 0.1, 0.4), "toilet paper": (0.12, 0.12, 0.11),
    "toothbrush": (0.03, 0.03, 0.18), "toothpaste": (0.05, 0.04, 0.18), "towel": (0.5, 0.1, 0.7),
    "toy": (0.2, 0.15, 0.15), "toy box": (0.7, 0.4, 0.4), "toy car": (0.2, 0.1, 0.08),
    "trash can": (0.3, 0.3, 0.5), "tv": (1.1, 0.1, 0.65), "tv stand": (1.5, 0.4, 0.5),
    "umbrella": (0.1, 0.1, 0.8), "vacuum cleaner": (0.35, 0.3, 0.9), "vase": (0.15, 0.15, 0.3),
    "wardrobe": (1.6, 0.6, 2.1), "washing machine": (0.6, 0.6, 0.85),
    "water heater": (0.45, 0.45, 0.9), "wine glass": (0.08, 0.08, 0.2),
}  # fmt: skip

# Things of a room type: "wall" stands at a wall, "floor" stands free, a number hangs at this height
# in metres, and other words are supports. A minus marks a thing that only some rooms have.
ROOMS: Final[dict[str, str]] = {
    "kitchen": (
        "wall: counter fridge stove dishwasher cabinet -oven; counter: sink kettle toaster "
        "microwave cutting_board pot -coffee_machine -bowl -fruit_bowl; stove: pan; "
        "floor: table chair chair trash_can; table: cup plate -bowl -fork"
    ),
    "living room": (
        "wall: sofa tv_stand bookshelf armchair -sideboard; tv_stand: tv; floor: coffee_table "
        "floor_lamp plant -basket; coffee_table: remote_control book -vase -cup; sofa: pillow "
        "pillow -blanket; bookshelf: -book -picture; 1.5: picture; 1.1: curtain"
    ),
    "bedroom": (
        "wall: bed nightstand wardrobe dresser -nightstand; nightstand: lamp alarm_clock; bed: "
        "pillow pillow blanket; dresser: -vase -book; 1.3: mirror -picture; 1.1: curtain"
    ),
    "bathroom": (
        "wall: toilet bathtub cabinet -washing_machine -shower; cabinet: sink toothbrush "
        "toothpaste -razor; bathtub: shampoo; 1.0: towel -towel; 0.7: toilet_paper; "
        "1.5: mirror; floor: toilet_brush -laundry_basket"
    ),
    "home office": (
        "wall: desk bookshelf -cabinet; desk: monitor keyboard mouse lamp notebook -telephone; "
        "cabinet: printer; floor: chair trash_can computer -backpack -box; bookshelf: book book; "
        "1.5: -picture; 1.1: -curtain"
    ),
    "dining room": (
        "wall: sideboard -cabinet; floor: table chair chair chair chair -plant; table: plate plate "
        "wine_glass fork -fruit_bowl -vase; sideboard: vase wine_glass -bowl; 1.5: picture; "
        "1.1: curtain"
    ),
    "nursery": (
        "wall: crib dresser toy_box -bookshelf -wardrobe; crib: blanket stuffed_animal -pillow; "
        "floor: toy toy_car doll -chair; dresser: lamp -toy; toy_box: toy; 1.5: picture; "
        "1.1: -curtain"
    ),
    "laundry room": (
        "wall: washing_machine clothes_dryer cabinet -water_heater; washing_machine: detergent; "
        "cabinet: iron -detergent; floor: laundry_basket ironing_board drying_rack bucket broom "
        "-vacuum_cleaner -basket"
    ),
    "entrance hall": (
        "wall: shoe_rack coat_rack bench -cabinet; shoe_rack: shoe shoe; floor: umbrella shoe "
        "-backpack; 1.4: coat mirror; bench: hat -backpack; 1.6: -picture"
    ),
}

# Things out of place: an object of some rooms in a room where it surprises every person.
ODD: Final[dict[str, str]] = {
    "kitchen": "toilet_brush toilet keyboard alarm_clock stuffed_animal crib toothbrush razor",
    "living room": "toothbrush pan toilet_brush washing_machine dishwasher shampoo toilet_paper",
    "bedroom": "pan toilet_brush toaster microwave cutting_board stove dishwasher pot",
    "bathroom": "toaster keyboard pan monitor microwave tv_stand printer cutting_board",
    "home office": "shampoo pan toilet_brush toaster toothpaste toilet razor pot",
    "dining room": "toilet_brush shampoo keyboard toothbrush alarm_clock iron toilet_paper razor",
    "nursery": "pan toaster stove toilet_brush cutting_board microwave pot printer",
    "laundry room": "alarm_clock plate keyboard toaster wine_glass tv monitor cutting_board",
    "entrance hall": "pan toaster toothbrush shampoo pot cutting_board stove toilet",
}
MUST_HAVE: Final = ("kitchen", "living room", "bedroom", "bathroom")


@dataclass(frozen=True)
class Thing:
    """An object of a flat. `place` is its centre in metres."""

    id: str
    label: str
    room: str
    place: Vector
    size: Vector
    is_intruder: bool = False


@dataclass(frozen=True)
class Flat:
    """Rooms as rectangles (x0, y0, x1, y1), and their things."""

    rooms: dict[str, tuple[float, float, float, float]]
    things: list[Thing]


def random_flat(seed: int) -> Flat:
    """Return a furnished flat of five rooms with five things out of place."""
    rng = random.Random(seed)
    others = rng.sample([name for name in ROOMS if name not in MUST_HAVE], 2)
    types = [*rng.sample(MUST_HAVE, 3), *others]
    rng.shuffle(types)
    rooms, y = {}, 0.0
    for row in (types[: (cut := rng.choice((2, 3)))], types[cut:]):
        depth, x = rng.uniform(3.2, 4.5), 0.0
        for name in row:
            width = rng.uniform(3.2, 5.0)
            rooms[name] = (x, y, x + width, y + depth)
            x += width
        y += depth
    things: list[Thing] = []
    for name, rectangle in rooms.items():
        things += _furnish(name, rectangle, rng, len(things))
    return Flat(rooms, things)


class _Room:
    """A room that is being furnished."""

    def __init__(
        self, name: str, rectangle: tuple[float, ...], rng: random.Random, count: int
    ) -> None:
        self.name, self.rectangle, self.rng, self.count = name, rectangle, rng, count
        self.things: list[Thing] = []
        self.used: list[tuple[float, float, float, float]] = []

    def put(self, label: str, x: float, y: float, bottom: float, is_odd: bool = False) -> None:
        w, d, h = SIZES[label]
        ident = f"{label}#{self.count + len(self.things)}"
        thing = Thing(ident, label, self.name, (x, y, bottom + h / 2), (w, d, h), is_odd)
        self.things.append(thing)

    def stand(self, label: str, at_wall: bool, is_odd: bool = False) -> None:
        """Put a thing on the floor, without overlap if there is space."""
        x0, y0, x1, y1 = self.rectangle
        w, d, _ = SIZES[label]
        for attempt in range(60):
            turned = at_wall and self.rng.random() < 0.5
            a, b = (d, w) if turned else (w, d)
            x = self.rng.uniform(x0 + a / 2 + 0.05, x1 - a / 2 - 0.05)
            y = self.rng.uniform(y0 + b / 2 + 0.05, y1 - b / 2 - 0.05)
            if at_wall and turned:
                x = self.rng.choice((x0 + a / 2 + 0.05, x1 - a / 2 - 0.05))
            elif at_wall:
                y = self.rng.choice((y0 + b / 2 + 0.05, y1 - b / 2 - 0.05))
            box = (x - a / 2, y - b / 2, x + a / 2, y + b / 2)
            if attempt == 59 or not any(_overlap(box, one) for one in self.used):
                self.used.append(box)
                self.put(label, x, y, 0.0, is_odd)
                return

    def lay(self, label: str, support: str, is_odd: bool = False) -> None:
        """Put a thing on a support, away from the others if there is space."""
        bases = [one for one in self.things if one.label == support]
        base = self.rng.choice(bases)
        top = base.place[2] + base.size[2] / 2
        best, farthest = (base.place[0], base.place[1]), -1.0
        for _ in range(12):
            reach = min(base.size[:2]) / 2 * 0.8
            x = base.place[0] + self.rng.uniform(-1, 1) * reach
            y = base.place[1] + self.rng.uniform(-1, 1) * reach
            gap = min(
                (abs(x - one.place[0]) + abs(y - one.place[1]) for one in self.things
                 if one is not base and one.place[2] > top - 0.05), default=9.0,
            )  # fmt: skip
            if gap > farthest:
                best, farthest = (x, y), gap
        self.put(label, *best, top, is_odd)

    def hang(self, label: str, height: float) -> None:
        x0, y0, x1, y1 = self.rectangle
        x, y = self.rng.uniform(x0 + 0.4, x1 - 0.4), self.rng.choice((y0 + 0.06, y1 - 0.06))
        self.put(label, x, y, max(0.0, height - SIZES[label][2] / 2))


def _furnish(
    name: str, rectangle: tuple[float, ...], rng: random.Random, count: int
) -> list[Thing]:
    room = _Room(name, rectangle, rng, count)
    for part in ROOMS[name].split(";"):
        where, _, words = part.strip().partition(": ")
        for word in words.split():
            if word.startswith("-") and rng.random() < 0.5:
                continue
            label = word.lstrip("-").replace("_", " ")
            support = where.replace("_", " ")
            if where in ("wall", "floor"):
                room.stand(label, where == "wall")
            elif where[0].isdigit():
                room.hang(label, float(where))
            elif any(one.label == support for one in room.things):
                room.lay(label, support)
            else:
                room.stand(label, at_wall=False)
    odd = rng.choice(ODD[name].split()).replace("_", " ")
    surfaces = [one.label for one in room.things if 0.4 < one.place[2] * 2 < 1.0 and
                min(one.size[:2]) > 0.4]  # fmt: skip
    if max(SIZES[odd]) < 0.5 and surfaces and rng.random() < 0.7:
        room.lay(odd, rng.choice(surfaces), is_odd=True)
    else:
        room.stand(odd, max(SIZES[odd]) >= 0.5, is_odd=True)
    return room.things


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
