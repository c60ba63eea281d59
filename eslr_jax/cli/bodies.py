"""`eslr joints`: how a motion's joints are matched to a body's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from eslr_jax.cli.console import app, stderr


@app.command
def joints(
    motion: str,
    body: str = "anny",
    joint_map: Path | None = None,
    out: Path | None = None,
    json_: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> None:
    """Show which joint of a motion each joint of a body follows.

    Args:
        motion: Name of a bundled motion, or a motion file: BVH, AMASS (.npz), HOOD or VTO (.pkl), or glTF.
        body: Name of a bundled body, or a body file.
        joint_map: JSON file of changes: a joint of the body to one of the motion, "" to keep it still.
        out: File to write the map to; change it and give it to `eslr simulate --joint-map`.
        json_: Print as JSON.
    """
    from eslr_jax.assets import load_body
    from eslr_jax.assets.motions import moving_skeleton, read_joint_map
    from eslr_jax.body.joints import map_joints
    from eslr_jax.body.rig import body_skeleton, is_body_model
    from eslr_jax.io.atomic import atomic_write

    target = body_skeleton(load_body(body))
    source = moving_skeleton(motion)
    changes = None if joint_map is None else read_joint_map(joint_map)
    found = map_joints(target, source.skeleton, changes, same_names=is_body_model(target, source))
    values = {name: found.get(name, "") for name in target.joint_names}
    if out is not None:
        with atomic_write(out) as temporary:
            temporary.write_text(json.dumps(values, indent=2))
    if json_:
        print(json.dumps(values, indent=2))
        return
    table = Table("joint of the body", "follows", box=None)
    for name, other in values.items():
        table.add_row(name, other or "-")
    Console().print(table, markup=False, highlight=False)
    unused = [name for name in source.skeleton.joint_names if name not in found.values()]
    stderr.print(f"not used: {', '.join(unused) or 'none'}", markup=False, highlight=False)
