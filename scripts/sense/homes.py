"""Measure `/where` in kept-out houses, with weights of several splits of the scenes.

    python -m scripts.sense.homes [CONFIGURATION] [--splits 0,1,2] [--data ../shared/data]
        [--source procthor]

For each split, a model is trained without its test scenes, and calibrated. Nothing is published.
Printed are the metrics of the task `Where` (`training.evaluation.where_task`) of the test houses,
and the differences of the first room to both rivals, with intervals of 95 %. A split takes about
six minutes on two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from app.model import SceneModel
from training.datasets.batches import TrainingData, subset
from training.evaluation.metrics import paired_difference
from training.evaluation.setting import Setting
from training.evaluation.where_task import RIVALS, where_task
from training.fit.trainer import Trainer
from training.runs.config_files import load_config, with_settings
from training.runs.folder import load_run, save_run
from training.runs.pipeline import prepare
from training.runs.publish import calibrated_draft, with_statistics


def trained(configuration: str, split: int, root: Path) -> tuple[SceneModel, TrainingData]:
    """Return a calibrated model of one split, and its scenes."""
    config = with_settings(load_config(configuration), {"data.split_seed": split})
    scenes = prepare(config, root)
    data = scenes.training_data()
    result = Trainer(config, data).run()
    with TemporaryDirectory() as folder:
        save_run(Path(folder) / "run", config, result, data=root, scenes=scenes.digest)
        run = load_run(Path(folder) / "run")
    return with_statistics(calibrated_draft(run, scenes), scenes), data


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("configuration", nargs="?", default="places-triway")
    parser.add_argument("--splits", default="0,1,2")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--source", default="procthor")
    options = parser.parse_args()
    for split in map(int, options.splits.split(",")):
        model, data = trained(options.configuration, split, options.data)
        test = data.test
        rows = [k for k, one in enumerate(test.scenes) if one.source == options.source]
        houses = subset(test, torch.tensor(rows))
        outcome = where_task(model, Setting(houses, data.structure, data.train, limit=None))
        print(f"split {split}", flush=True)
        if outcome is None:
            print("  no test house has three rooms")
            continue
        for name, metric in outcome.metrics.items():
            print(f"  {name}: {metric.figure()}")
        for rival in RIVALS:
            difference = paired_difference(outcome.metrics["first room"], outcome.metrics[rival])
            print(f"  minus {rival}: {difference}", flush=True)


if __name__ == "__main__":
    main()
