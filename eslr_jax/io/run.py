"""Read the folder that `eslr simulate` writes: trajectory, garment and report."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from eslr_jax.errors import AssetError
from eslr_jax.io.garment import GarmentFile, read_garment_npz
from eslr_jax.io.trajectory import TrajectoryFile, read_trajectory


@dataclasses.dataclass(frozen=True)
class Run:
    """One simulation on disk."""

    name: str
    trajectory: TrajectoryFile
    garment: GarmentFile | None  # None without garment.npz: then frame 0 is the rest shape
    report: dict[str, Any]  # of report.json; empty without it


def read_run(path: str | Path) -> Run:
    """Read the folder of a run, or a trajectory and what lies beside it.

    Args:
        path: Path of the folder, or of a trajectory file.

    Returns:
        The run.

    Raises:
        AssetError: There is no trajectory, a file is damaged, or the garment is not the trajectory's.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    file = path / "trajectory.npz" if path.is_dir() else path
    if not file.is_file():
        raise AssetError(f"{path} is no run: {file} doesn't exist; give a folder that `eslr simulate` wrote")
    trajectory = read_trajectory(file)
    garment = None
    if (folder / "garment.npz").is_file():
        garment = read_garment_npz(folder / "garment.npz")
        if len(garment.rest_positions) != trajectory.positions.shape[1]:
            raise AssetError(
                f"{folder}: garment.npz has {len(garment.rest_positions)} vertices and the trajectory "
                f"{trajectory.positions.shape[1]}; simulate it again"
            )
    report: dict[str, Any] = {}
    if (folder / "report.json").is_file():
        try:
            report = json.loads((folder / "report.json").read_text())
        except (OSError, ValueError) as error:
            raise AssetError(f"{folder / 'report.json'} is damaged; simulate it again") from error
    return Run(folder.resolve().name if path.is_dir() else path.stem, trajectory, garment, report)
