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
    "nr3d": Terms(
        "Nr3D (Achlioptas et al., ECCV 2020): triples from descriptions of ScanNet rooms; "
        "research use",
        research_only=True,
    ),
    "coco_captions": Terms(
        "COCO captions (Lin et al., ECCV 2014): triples from captions of indoor pictures; "
        "CC BY 4.0",
        research_only=False,
    ),
    "reverie_text": Terms(
        "REVERIE (Qi et al., CVPR 2020): triples from instructions for Matterport houses; "
        "non-commercial use",
        research_only=True,
    ),
    "alfred": Terms(
        "ALFRED (Shridhar et al., CVPR 2020): AI2-THOR rooms and triples from instructions; MIT",
        research_only=False,
    ),
    "bddl_goal": Terms(
        "BEHAVIOR-1K (Li et al., CoRL 2022): end states of household activities; MIT",
        research_only=False,
    ),
    "behavior1k_rooms": Terms(
        "BEHAVIOR-1K (Li et al., CoRL 2022): object lists of rooms; MIT", research_only=False
    ),
    "vsr": Terms(
        "Visual Spatial Reasoning (Liu, Emerson, Collier, TACL 2023): voted relations in "
        "photographs; Apache-2.0",
        research_only=False,
    ),
    "placing_priors": Terms(
        "VirtualHome (Puig et al., CVPR 2018), AI2-THOR (Kolve et al., 2017) and TidyBot (Wu et "
        "al., 2023): where things are placed; MIT and Apache-2.0",
        research_only=False,
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
