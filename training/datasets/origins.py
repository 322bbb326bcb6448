"""Where each public data set is to be had, and how to bring it into a file of scenes.

These data sets are outside the repository. The command `training fetch` prints this table and
checks the files in a folder; it downloads nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from training.datasets.priors import SOURCE as PRIORS
from training.datasets.priors import read_prior_scenes
from training.datasets.readers import read_scenes
from training.datasets.words import read_word_vectors

WORDS: Final = "word_vectors"
"""Name of the word vectors in `ORIGINS`, which the indoor models use beside the scenes."""

_SENTENCES: Final = (
    "extract (subject, relation, object) from each sentence; one scene per {unit}, one object per "
    "label, the triples under relations"
)


@dataclass(frozen=True, slots=True)
class Origin:
    """The origin of a data file.

    Attributes:
        home: home page of the project.
        files: official files that are needed.
        steps: how these files become scenes of our format, or which reader reads them.
        place: path of the file in the data folder.
        terms: origin and licence. Empty for a source of `SOURCES`, which states them.
    """

    home: str
    files: str
    steps: str
    place: str
    terms: str = ""


def _extra(name: str) -> str:
    return f"extra/{name}.jsonl.gz"


ORIGINS: Final[dict[str, Origin]] = {
    "sunrgbd": Origin(
        "https://rgbd.cs.princeton.edu",
        "seglistall.csv of github.com/crmauceri/SUNRGBD_COCO, and scene.txt of each frame in "
        "SUNRGBD.zip",
        "one scene per frame: the labels whose column images lists the frame, and the room type "
        "of scene.txt; the same group for consecutive frames",
        "sunrgbd.jsonl.gz",
    ),
    "sunrgbd_bedrooms_3d": Origin(
        "https://rgbd.cs.princeton.edu",
        "SUNRGBDMeta3DBB_v2.mat, and SUNRGBD.zip unpacked beside it (scene.txt of each frame)",
        "the reader sunrgbd-mat reads the .mat file; keep the bedrooms and their centres",
        "sunrgbd_bedrooms_3d.jsonl.gz",
    ),
    "3dssg": Origin(
        "https://3dssg.github.io",
        "relationships.json of 3DSSG_subset.zip, objects.json of 3DSSG.zip, and "
        "campar.in.tum.de/public_datasets/3RScan/3RScan.json, in one folder",
        "the reader 3dssg reads relationships.json",
        "3dssg.jsonl.gz",
    ),
    "procthor": Origin(
        "https://procthor.allenai.org",
        "train.jsonl.gz of github.com/allenai/procthor-10k (one house a line)",
        "one scene per room: label, position (z up), size and supported_by of each object; the "
        "house is the group",
        "procthor.jsonl.gz",
    ),
    "vrd": Origin(
        "https://cs.stanford.edu/people/ranjaykrishna/vrd",
        "annotations_train.json, annotations_test.json, objects.json and predicates.json of "
        "json_dataset.zip",
        "one scene per photograph: label and box2d of each object; relations keep the predicates "
        "of VRD, such as [0, 'on the top of', 1]",
        "vrd.jsonl.gz",
    ),
    "nr3d": Origin(
        "https://referit3d.github.io",
        "nr3d.csv (the page Benchmarks has the link)",
        _SENTENCES.format(unit="ScanNet room"),
        _extra("nr3d"),
    ),
    "coco_captions": Origin(
        "https://cocodataset.org",
        "captions_train2017.json and captions_val2017.json of annotations_trainval2017.zip",
        _SENTENCES.format(unit="indoor picture") + "; the picture is the group (coco-NUMBER)",
        _extra("coco_captions"),
    ),
    "reverie_text": Origin(
        "https://github.com/YuankaiQi/REVERIE",
        "REVERIE_train.json, REVERIE_val_seen.json and REVERIE_val_unseen.json of data.zip",
        _SENTENCES.format(unit="viewpoint") + "; the Matterport house is the group",
        _extra("reverie_text"),
    ),
    "alfred": Origin(
        "https://askforalfred.com",
        "traj_data.json of each episode in json_2.1.0.7z (data/download_data.sh of "
        "github.com/askforalfred/alfred, option json)",
        _SENTENCES.format(unit="episode") + "; counts of the movable objects; the floor plan is "
        "the group",
        _extra("alfred"),
    ),
    "bddl_goal": Origin(
        "https://behavior.stanford.edu",
        "bddl3/bddl/activity_definitions/*/problem0.bddl of github.com/StanfordVL/BEHAVIOR-1K",
        "one scene per goal condition: its objects, and the predicates ontop and under as the "
        "relations on-top and under; the activity is the group",
        _extra("bddl_goal"),
    ),
    "behavior1k_rooms": Origin(
        "https://behavior.stanford.edu",
        "bddl3/bddl/generated_data/combined_room_object_list.json of "
        "github.com/StanfordVL/BEHAVIOR-1K",
        "one scene per room: labels and counts, relations null; the house is the group",
        _extra("behavior1k_rooms"),
    ),
    "vsr": Origin(
        "https://github.com/cambridgeltl/visual-spatial-reasoning",
        "data/data_files/all_vsr_validated_data.jsonl",
        "one scene per picture: a statement with label 1 is a relation, one with label 0 belongs "
        "under false_relations; the picture is the group (coco-NUMBER)",
        _extra("vsr"),
    ),
    PRIORS: Origin(
        "http://virtual-home.org, https://ai2thor.allenai.org, https://tidybot.cs.princeton.edu",
        "object_script_placing.json of github.com/xavierpuigf/virtualhome; the receptacles on the "
        "page Object Types of iTHOR; benchmark/scenarios.yml of github.com/jimmyyhwu/tidybot",
        "a table with the columns source, subject, relation, object, count and room; source is "
        "virtualhome_placing, ithor_receptacles or tidybot",
        f"extra/{PRIORS}.tsv.gz",
    ),
    WORDS: Origin(
        "https://nlp.stanford.edu/projects/glove",
        "glove.6B.100d.txt of glove.6B.zip",
        "numpy.savez with words, vectors (int8: value / scale, rounded) and scale",
        f"extra/{WORDS}.npz",
        "GloVe (Pennington, Socher, Manning, EMNLP 2014): word vectors; public domain (PDDL)",
    ),
}


def file_of(name: str, root: Path) -> Path:
    """Return the path of a source's file in a data folder, also if the file is missing.

    The file `NAME.jsonl.gz` of a source is either in the folder or in its subfolder `extra`.
    """
    if name in (PRIORS, WORDS):
        return root / ORIGINS[name].place
    path, extra = root / f"{name}.jsonl.gz", root / _extra(name)
    known = name in ORIGINS and ORIGINS[name].place.startswith("extra/")
    return extra if extra.is_file() or (known and not path.is_file()) else path


def count_entries(name: str, root: Path) -> int:
    """Read the file of a source completely. Return its number of scenes (rows, words).

    Raises:
        DatasetError: the file cannot be read.
    """
    path = file_of(name, root)
    if name == WORDS:
        return len(read_word_vectors(path).words)
    return len(read_prior_scenes(path) if name == PRIORS else read_scenes(path))
