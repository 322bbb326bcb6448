"""The question `outliers`: which objects do not belong, and which stated relations are wrong?

An intruder is an object that does not belong to the scene. An outlier is an object that the service
reports as a probable intruder. The answer for an outlier names its companions: absent classes that
usually occur with the class of the outlier. `ObjectScorer.increases` says how much the presence of
a class raises the log-odds of the others.

Rare classes have the largest increases, such as a toilet paper holder for a toilet. Common classes
such as chair are likely in any scene. So companions are ranked by a product: the increase,
multiplied by the probability of the companion in a scene with the outlier. Classes whose increase
is below half of the largest increase are ignored.
"""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.model.calibration import Sensitivity
from app.model.scene_model import SceneModel
from app.questions.answer import EXPLAINED, Fields, best, reasons, rounded_number, significant
from app.questions.doubt import LEAST_REAL, Doubt, doubt
from app.questions.misplaced import misplaced_fields
from app.questions.posterior import Posterior
from app.questions.question import REFUSED, SCENES, WITH_TOILET, Example, Options, Question
from app.questions.reading import Reading
from app.scene.scene import Scene, SceneObject
from scene_client.schemas import OutliersAnswer, OutliersRequest, SceneWarning

Floats = NDArray[np.floating[Any]]

COMPANIONS: Final = 3  # maximum number of companions in the answer for one outlier

_LEAST_SHARE: Final = 0.5  # smallest increase of a companion, as a share of the largest
_LEAST_INCREASE: Final = 1e-6


def outliers(
    model: SceneModel,
    scene: Scene,
    *,
    sensitivity: Sensitivity = "medium",  # one of the model's thresholds
    threshold: float | None = None,  # minimum probability of an outlier, instead of `sensitivity`
    details: bool = True,  # whether the answer contains `because` and `usually_with`
) -> Fields:
    """Judge every object and every stated relation of a scene.

    Probable intruders and probably false relations come first. Objects and relations with equal
    scores keep the order of the request.

    The score of an object is the log-odds of its class given the rest of the scene, without the
    instances of the class and their relations. Intruders are often common objects in the wrong
    room, so they have a prior (`SceneModel.intruder_prior`). Structural classes, such as wall, and
    classes that belong anywhere, such as cat or bag, always have the probability 0. A scene with
    few objects gives little evidence, so its threshold is higher. A single class without structure
    is never an outlier.

    The model knows little about a class that few training scenes show (`rarely_shown`). At a
    sensitivity, an object of such a class is never an outlier. If its probability reaches the
    threshold, a warning names the object. A stated threshold applies to all classes, but a word
    that is read by its meaning never is an outlier.

    Returns:
        The fields `threshold`, `outliers` and `misplaced` of `scene_client.schemas.OutliersAnswer`.
        A list is empty if the model gives no such judgement. `warnings` names this case, a single
        class, and the objects of rare classes that reach the threshold.
        `threshold` is left out if the model judges no object and the caller states no threshold.

    Example:
        >>> labels = ["bed", "nightstand", "pillow", "toilet"]
        >>> scene = Scene(model.vocabulary.bare_objects(labels))
        >>> outliers(model, scene)["outliers"][0]["object"]
        'toilet'
    """
    can_alarm = ~model.rarely_shown if threshold is None else np.ones_like(model.rarely_shown)
    can_alarm[model.vocabulary.trained :] = False
    judged: list[Fields] = []
    wrong: list[Fields] = []
    warnings = _unjudged(model, scene)
    posterior = Posterior(model, scene) if scene.objects else None
    if threshold is None:
        n, in_room = posterior.listed if posterior else 0, scene.room_type is not None
        threshold = model.calibration.outlier_threshold(sensitivity, n, in_room=in_room)
    if posterior is not None:
        log_odds, change = posterior.given_rest(explained=details)
        about = doubt(model, posterior, log_odds)
        wrong = misplaced_fields(model, posterior, scene, sensitivity, about.real)
        if model.calibration.outlier is not None and threshold is not None:
            changes = change if details else None
            judged, silent = _judged(model, posterior, scene, about, changes, threshold, can_alarm)
            warnings += _too_rare(model, silent) + _alone(model, posterior, scene)
    fields: Fields = {"warnings": warnings}
    if threshold is not None:
        fields["threshold"] = rounded_number(threshold)
    return fields | {"outliers": judged, "misplaced": wrong}


def _judged(
    model: SceneModel,
    posterior: Posterior,
    scene: Scene,
    about: Doubt,
    change: Float[Floats, "n n"] | None,  # of log-odds by each class; None: without details
    threshold: float,
    can_alarm: Bool[NDArray[np.bool_], "V"],
) -> tuple[list[Fields], list[SceneObject]]:
    """Return the fields of `scene_client.schemas.Outlier` for every object of a scene.

    The second result lists the objects that reach the threshold, but whose class raises no alarm.
    `because` lists the other objects with the strongest effects. These raise the `log_odds` of an
    object that reaches the threshold, and lower those of other objects. Doubt about an object
    reduces its effects.
    """
    present, vocabulary = posterior.present, model.vocabulary
    labels, broader = vocabulary.labels, vocabulary.broader_labels
    logits, p, presence = about.logits, about.p, about.presence
    reaches = (p >= threshold) & (posterior.listed > 1)
    may_alarm = reaches & can_alarm[present.classes]
    # The order follows the logits, because probabilities near 0 or 1 may round to the same number.
    order = (-logits[present.row]).argsort(kind="stable")
    rows, flags, n = present.row[order].tolist(), may_alarm.tolist(), len(p)
    causes: list[list[Fields]] = [[] for _ in flags]
    companions: list[list[str]] = [[] for _ in flags]
    explained = set(rows[:EXPLAINED])
    classes, probabilities, values = present.classes.tolist(), significant(p), significant(logits)
    if change is not None and n > 1:
        change = change * (presence / present.presence)
        lowered, raised = np.minimum(change, 0), np.maximum(change, 0)
        change = np.where(may_alarm[:, None], lowered, raised)
        slope = model.calibration.outlier.slope  # type: ignore[union-attr]
        causes = reasons(scene, present, change, np.arange(n), scale=slope)
        for row in explained:
            if flags[row]:
                companions[row] = _companions(model, present.classes, classes[row])
    judged: list[Fields] = []
    certainty = significant(about.real[order]) if about.is_unsure else [1.0] * len(rows)
    for number, row, certain in zip(order.tolist(), rows, certainty, strict=True):
        thing = scene.objects[number]
        fields: Fields = {"object": thing.id, "label": labels[classes[row]]}
        if thing.label != fields["label"]:
            fields["listed_as"] = thing.label
        if broader[classes[row]]:
            fields["broader"] = broader[classes[row]]
        fields["probability"] = probabilities[row]
        if probabilities[row]:
            fields["log_odds"] = values[row]
        if about.is_unsure:
            fields["real"] = certain
        is_outlier = fields["is_outlier"] = flags[row] and certain >= LEAST_REAL
        if is_outlier or certain < LEAST_REAL:
            fields["reason"] = "does-not-belong" if is_outlier else "misdetection"
        if change is not None:
            fields["because"] = causes[row] if row in explained else []
            fields["usually_with"] = companions[row]
        judged.append(fields)
    silent = np.flatnonzero((reaches & ~may_alarm)[present.row])
    return judged, [scene.objects[number] for number in silent.tolist()]


def misplaced(
    model: SceneModel, scene: Scene, *, sensitivity: Sensitivity = "medium"
) -> list[Fields]:
    """Judge every stated relation like `outliers`, but do not judge objects.

    Example:
        >>> bed_on_nightstand = RelationTable.stated([(ON_TOP, 0, 1)])
        >>> scene = Scene(model.vocabulary.bare_objects(["bed", "nightstand"]), bed_on_nightstand)
        >>> misplaced(model, scene)[0]["is_misplaced"]
        True
    """
    if not scene.objects:
        return []
    posterior = Posterior(model, scene)
    about = doubt(model, posterior, posterior.given_rest()[0])
    return misplaced_fields(model, posterior, scene, sensitivity, about.real)


def intruders(model: SceneModel, scene: Scene) -> NDArray[np.int64]:
    """Return the classes that reach the threshold of medium sensitivity, rare classes included."""
    calibration, posterior = model.calibration, Posterior(model, scene)
    classes, in_room = posterior.present.classes, scene.room_type is not None
    threshold = calibration.outlier_threshold("medium", posterior.listed, in_room=in_room)
    if calibration.outlier is None or threshold is None:
        return classes[:0]
    p = doubt(model, posterior, posterior.given_rest()[0]).p
    return classes[(p >= threshold) & (posterior.listed > 1)]


def _companions(model: SceneModel, present: Int[NDArray[np.int64], "n"], flagged: int) -> list[str]:
    """Return the labels of the companions of an outlier, best first; see the module."""
    increase, rank = model.objects.increases(flagged)
    chosen = _typical(increase, rank, model.vocabulary.structure, present)
    return [model.vocabulary.labels[index] for index in chosen.tolist()]


@compiled
def _typical(
    increase: Float[NDArray, " V"],
    rank: Float[NDArray, " V"],
    structure: Bool[NDArray, " V"],
    present: Int[NDArray, " n"],
) -> Int[NDArray, " k"]:
    """Return the companions of a class: `ObjectScorer.increases` gives increase and rank."""
    usable, largest = ~structure, np.float32(0.0)
    usable[present] = False
    for j in range(len(usable)):
        if usable[j]:
            largest = max(largest, increase[j])
    least = max(_LEAST_SHARE * largest, _LEAST_INCREASE)
    for j in range(len(usable)):
        usable[j] &= increase[j] >= least and rank[j] > 0
    return best(rank, usable, COMPANIONS)


def _too_rare(model: SceneModel, objects: list[SceneObject]) -> list[SceneWarning]:
    """Return a warning for objects that reach the threshold, but whose class is rarely shown."""
    if not objects:
        return []
    classes = {thing.class_index for thing in objects}
    labels = sorted(model.vocabulary.labels[index] for index in classes if index is not None)
    message = (
        f"too few or no training scenes show {', '.join(labels)}, so the service raises no alarm"
    )
    ids = [thing.id for thing in objects]
    return [SceneWarning(code="not-judged", message=message, objects=ids)]


def _alone(model: SceneModel, posterior: Posterior, scene: Scene) -> list[SceneWarning]:
    """Return a warning if the scene lists a single class without structure, and it is judged."""
    present, vocabulary = posterior.present, model.vocabulary
    if posterior.listed != 1 or not vocabulary.judged[present.classes].any():
        return []
    rows = ~vocabulary.structure[present.classes][present.row]
    ids = [thing.id for thing, is_thing in zip(scene.objects, rows, strict=True) if is_thing]
    message = "the scene has objects of one class, so nothing says whether they belong to it"
    return [SceneWarning(code="not-judged", message=message, objects=ids)]


def _unjudged(model: SceneModel, scene: Scene) -> list[SceneWarning]:
    """Return a warning for objects, and one for relations, if the model gives no judgement."""
    calibration = model.calibration
    parts = ["objects"] if scene.objects and calibration.outlier is None else []
    if scene.triples and not calibration.misplaced.judges_relations:
        parts.append("relations")
    message = "the model does not judge {}, because its calibration had too few scenes"
    return [
        SceneWarning(code="not-judged", message=message.format(part), objects=[]) for part in parts
    ]


def _read(request: OutliersRequest, _: SceneModel, __: Reading) -> Options:
    """Return the keyword arguments of `outliers` for a request."""
    return {
        "sensitivity": request.sensitivity,
        "threshold": request.threshold,
        "details": request.detail == "full",
    }


def _ask_all(model: SceneModel, scenes: tuple[Scene, ...]) -> Iterator[Fields]:
    # With threshold 0, every object is an outlier. So the function also computes `usually_with`.
    yield outliers(model, scenes[0], threshold=0.0)
    for scene in scenes[1:]:
        yield outliers(model, scene)


_EXAMPLES: Final = {
    "intruder": Example("a toilet in a bedroom", WITH_TOILET),
    **SCENES,
    "misplaced": Example(
        "relations that the request states, as arrays, and that may be wrong",
        {
            "objects": ["bed", "pillow", "nightstand"],
            "relations": [["pillow", "on-top", "bed"], ["bed", "on-top", "nightstand"]],
        },
    ),
    "sensitivity": Example(
        "high sensitivity: a lower threshold", {**WITH_TOILET, "sensitivity": "high"}
    ),
    "threshold": Example("a threshold set by the client", {**WITH_TOILET, "threshold": 0.5}),
    "scores": Example(
        "probabilities only, for a fast and short answer", {**WITH_TOILET, "detail": "scores"}
    ),
    **REFUSED,
}
_EXAMPLE_ANSWER: Final = {
    "threshold": 0.7,
    "outliers": [
        {
            "object": "wc_1", "label": "toilet", "listed_as": "WC", "probability": 0.94,
            "log_odds": 2.75, "real": 0.9, "is_outlier": True, "reason": "does-not-belong",
            "because": [{"object": "bed", "log_odds_change": 1.8}],
            "usually_with": ["toilet paper", "sink", "faucet"],
        },
        {
            "object": "bed", "label": "bed", "probability": 0.03, "log_odds": -3.48, "real": 0.98,
            "is_outlier": False,
            "because": [{"object": "lamp_1", "log_odds_change": -0.6}],
            "usually_with": [],
        },
    ],
    "misplaced": [{
        "subject": "lamp_1", "relation": "on-top", "object": "nightstand_1", "probability": 0.05,
        "is_misplaced": False, "reason": "relation", "moved": "lamp_1",
    }],
}  # fmt: skip

_TEXT: Final = """
Return probabilities that each object is an outlier and that each observed relation is false.

The list `outliers` starts with the most probable outlier. All instances of a class have the
same probability. The list `misplaced` starts with the relation that is most probably false.
"""
OUTLIERS: Final = Question(
    outliers, _read, OutliersRequest, OutliersAnswer, _EXAMPLES, _EXAMPLE_ANSWER, _TEXT, _ask_all
)
