"""Where the scenes come from and what they may be used for; goes into every model card."""

from __future__ import annotations

from dataclasses import dataclass

from training.config import DataConfig


@dataclass(frozen=True)
class Terms:
    """Provenance and licence of a source, in words, and whether it is for research only."""

    words: str
    research_only: bool


TERMS: dict[str, Terms] = {
    "sunrgbd": Terms(
        "SUN RGB-D (Song, Lichtenberg, Xiao, CVPR 2015): object labels and scene types of real "
        "RGB-D frames; research use",
        research_only=True,
    ),
    "sunrgbd_bedrooms_3d": Terms(
        "SUN RGB-D (Song, Lichtenberg, Xiao, CVPR 2015): 3D boxes of real bedrooms; research use",
        research_only=True,
    ),
    "3dssg": Terms(
        "3DSSG (Wald, Dhamo, Navab, Tombari, CVPR 2020) on 3RScan: annotated relations of real "
        "rooms; research use",
        research_only=True,
    ),
    "procthor": Terms(
        "ProcTHOR (Deitke et al., NeurIPS 2022): procedural rooms; Apache-2.0", research_only=False
    ),
    "vrd": Terms(
        "VRD (Lu, Krishna, Bernstein, Fei-Fei, ECCV 2016): annotated relations in photographs; "
        "research use",
        research_only=True,
    ),
    "rooms": Terms(
        "Rooms made by this project's own generator; no restriction", research_only=False
    ),
}


def terms_of(source: str, data: DataConfig) -> Terms:
    """The terms of a source that is known, or those that the configuration gives for its files."""
    if source in TERMS and source in data.sources:
        return TERMS[source]
    words = data.terms or "scenes of the user's own, whose terms were not stated"
    return Terms(words, data.research_only)
