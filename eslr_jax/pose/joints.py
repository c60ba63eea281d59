"""Which joint is which: parts of a body by the joint names of common rigs, and joint maps between two rigs.

A part is a side and a chain, such as left `upper_leg`; spine, neck and fingers are chains of several joints.
Known are the names of CMU (BVH and ASF), Mixamo, SMPL, Biped, Unreal, VRM, Rigify, Daz, MakeHuman, OptiTrack,
Xsens, Kinect, AdvancedSkeleton, and the LeftCollar/LeftShoulder/LeftElbow family. What most names of a rig
begin or end with is left out, and the hierarchy tells what is between the joints that are known.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence

import numpy as np

from eslr_jax.errors import MotionError
from eslr_jax.pose.skeleton import Skeleton

Part = tuple[str, str]  # side ("left", "right", "") and chain

_SIDES = {"left": "left", "l": "left", "lft": "left", "right": "right", "r": "right", "rgt": "right"}
_SIDES |= dict.fromkeys(("m", "c", "center"), "")  # of the middle
_PREFIXES = re.compile(
    r"^(mixamorig\d*|bip\d*|bip01|cc_base|def|org|character\d*|rig|j_bip(_c)?|j|valvebiped)[\s_.:-]+",
    re.IGNORECASE,
)
_IGNORED = {"twist", "roll", "end", "nub", "ik", "pole", "ctrl", "helper", "site", "share", "metacarpal"}
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def _by_word(words: Mapping[str, str]) -> dict[str, str]:
    return {word: chain for chain, names in words.items() for word in names.split()}


_WORDS = _by_word(  # with a side or without one
    {
        "hips": "hips pelvis",
        "root": "root",
        "spine": "spine lowerback upperback thorax chest upperchest torso abdomen abdomenlower abdomenupper "
        "chestlower chestupper waist",
        "neck": "neck lowerneck upperneck necklower neckupper",
        "head": "head skull",
    }
)
_SIDED_WORDS = _by_word(
    {
        "hip_joint": "hipjoint",
        "upper_leg": "upleg upperleg thigh femur hip thighbend",
        "lower_leg": "loleg lowerleg lowleg calf shin tibia knee leg",
        "foot": "foot ankle",
        "toe": "toe toes toebase ball",
        "clavicle": "clavicle collar scapula",
        "shoulder": "shoulder",
        "upper_arm": "uparm upperarm humerus arm shldr shldrbend uarm",
        "forearm": "loarm lowerarm lowarm forearm radius elbow forearmbend farm",
        "hand": "hand",
        "wrist": "wrist",
        "fingers": "fingers fingerbase handfinger",
        **{finger: f"{finger} hand{finger} f{finger}" for finger in _FINGERS},
    }
)
_SIDED_WORDS |= {"mid": "middle", "little": "pinky", "handlittle": "pinky"}
HAND = ("hand", "fingers", *_FINGERS)  # parts that continue the forearm's bone
_SHARED = 0.75  # of a rig's names that begin alike: the rest are roots and props
_CHAINS = {"foot": ("upper_leg", "lower_leg", "foot"), "hand": ("upper_arm", "forearm", "hand")}
_FALLBACKS = {"fingers": ("middle", "index"), "hip_joint": (), "toe": ()} | {
    finger: ("fingers",) for finger in _FINGERS[1:]
}


def _words(name: str) -> list[str]:
    """Return the words and numbers of a name in capitals, snake case or camel case."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+", name)]


def name_part(name: str) -> Part | None:
    """Return the part that a joint's name alone stands for, or None if it is unknown."""
    name = re.split(r"[:|]", name)[-1]
    if name.startswith("__"):  # a helper of MakeHuman, in the place of the joint that follows
        return None
    words = _words(_PREFIXES.sub("", name))
    if not words or _IGNORED & set(words):
        return None
    side = ""
    for position in (0, -1, *range(1, len(words) - 1)):
        if words[position] in _SIDES and len(words) > 1:
            side = _SIDES[words.pop(position)]
            break
    digits = [word for word in words if word.isdigit()]
    base = "".join(word for word in words if not word.isdigit())
    if not side and base not in _WORDS and base[:1] in ("l", "r") and base[1:] in _SIDED_WORDS:
        side, base = _SIDES[base[0]], base[1:]  # lfemur, rThigh
    if not side and base.startswith(("left", "right")):
        side = "left" if base.startswith("left") else "right"
        base = base.removeprefix(side)
    if side and base == "finger" and digits and int(digits[0][0]) < len(_FINGERS):
        return side, _FINGERS[int(digits[0][0])]  # Biped: Finger0 is the thumb, Finger01 its second joint
    if side and base in _SIDED_WORDS:
        return side, _SIDED_WORDS[base]
    if not side and base in (*_WORDS, "hip"):
        return "", _WORDS.get(base, "hips")
    return None


def _shared_start(names: Sequence[str]) -> str:
    """Return the longest text that most names begin with, as "mixamorig" or "Robot_"."""
    middle = sorted(names)[len(names) // 2] if names else ""
    lengths = range(len(middle), 0, -1)
    most = _SHARED * len(names)
    return next(
        (middle[:n] for n in lengths if sum(name.startswith(middle[:n]) for name in names) >= most), ""
    )


def find_named_parts(joint_names: Sequence[str]) -> dict[Part, list[int]]:
    """Return the joints of every part that is known by name, in the order of the names.

    Shoulder, foot and hand mean different joints in different families; the other names of the rig decide.
    """
    found: dict[Part, list[int]] = {}
    start, end = _shared_start(joint_names), _shared_start([name[::-1] for name in joint_names])[::-1]
    for joint, name in enumerate(joint_names):
        part = name_part(name) or name_part(name.removeprefix(start).removesuffix(end))
        if part is not None:
            found.setdefault(part, []).append(joint)
    for side in ("left", "right"):
        if (side, "shoulder") in found:
            is_clavicle = (side, "clavicle") not in found and (side, "upper_arm") in found
            found[side, "clavicle" if is_clavicle else "upper_arm"] = found.pop((side, "shoulder"))
        if (side, "wrist") in found:
            joints = found.pop((side, "wrist"))
            if (side, "hand") in found:
                found[side, "fingers"] = found.pop((side, "hand")) + found.get((side, "fingers"), [])
            found[side, "hand"] = joints
        feet = found.get((side, "foot"), [])
        ankles = [joint for joint in feet if "ankle" in joint_names[joint].lower()]
        if ankles and len(ankles) < len(feet):
            beyond = [joint for joint in feet if joint not in ankles]
            found[side, "foot"] = ankles
            found[side, "toe"] = beyond + found.get((side, "toe"), [])
    return found


def find_parts(skeleton: Skeleton) -> dict[Part, list[int]]:
    """Return the joints of every part of a rig, from the hips outwards; the hips are always among them."""
    found = find_named_parts(skeleton.joint_names)
    chest = _complete_limbs(skeleton, found)
    hips = _find_hips(skeleton, found)
    _complete_spine(skeleton, found, hips, chest)
    found.pop(("", "root"), None)
    found = {part: kept for part, joints in found.items() if (kept := [j for j in joints if j != hips])}
    found["", "hips"] = [hips]
    return found


def _path(skeleton: Skeleton, joint: int) -> list[int]:
    """Return a joint and those that it hangs on, without helpers, up to the root."""
    path = []
    while joint >= 0:
        if not _IGNORED.intersection(_words(skeleton.joint_names[joint])):
            path.append(joint)
        joint = skeleton.parents[joint]
    return path


def _complete_limbs(skeleton: Skeleton, found: dict[Part, list[int]]) -> int | None:
    """Add the joints between hands or feet and the trunk that their names don't tell; return where arms begin."""
    branch = None
    for end, chain in _CHAINS.items():
        paths = {
            side: _path(skeleton, found[side, end][0]) for side in ("left", "right") if (side, end) in found
        }
        if len(paths) < 2:
            continue
        shared = [joint for joint in paths["left"] if joint in paths["right"]]
        branch = shared[0] if shared and end == "hand" else None
        for side, path in paths.items():
            own = [joint for joint in path if joint not in shared]
            if all((side, part) in found for part in chain) or len(own) < len(chain):
                continue
            for part, joints in list(found.items()):
                found[part] = [joint for joint in joints if joint not in own]
                if not found[part]:
                    del found[part]
            found |= {(side, part): [joint] for part, joint in zip(reversed(chain), own, strict=False)}
            if end == "hand" and len(own) > len(chain):
                found[side, "clavicle"] = own[: len(chain) - 1 : -1]
    return branch


def _complete_spine(skeleton: Skeleton, found: dict[Part, list[int]], hips: int, chest: int | None) -> None:
    """Add the joints between the hips and what arms or head hang on that their names don't tell."""
    ends = found.get(("", "neck")) or found.get(("", "head")) or [hips]
    path = _path(skeleton, ends[0] if chest is None else chest)
    taken = {joint for part, joints in found.items() if part != ("", "spine") for joint in joints}
    between = path[: path.index(hips)] if hips in path else []
    spine = {*found.get(("", "spine"), []), *(joint for joint in between if joint not in taken)}
    if spine:
        found["", "spine"] = sorted(spine, key=lambda joint: (len(_path(skeleton, joint)), joint))


def _find_hips(skeleton: Skeleton, parts: Mapping[Part, list[int]]) -> int:
    """Return the joint that legs and spine hang on."""
    below = [
        parts[part][0]
        for part in (("left", "upper_leg"), ("right", "upper_leg"), ("", "spine"), ("", "neck"), ("", "head"))
        if part in parts
    ]
    has_legs = ("left", "upper_leg") in parts and ("right", "upper_leg") in parts
    if not has_legs or len(below) < 3:
        return parts.get(("", "hips"), parts.get(("", "root"), [0]))[0]
    chains = [{joint} for joint in below]
    for chain, joint in zip(chains, below, strict=True):
        while (joint := skeleton.parents[joint]) >= 0:
            chain.add(joint)
    return max(set.intersection(*chains), default=0)


def torso_axes(skeleton: Skeleton, parts: Mapping[Part, list[int]]) -> np.ndarray | None:
    """Return left, up and front of the resting torso as columns, shape [3, 3]; None if they are not known."""
    rest = skeleton.rest_positions
    for chain in ("upper_leg", "upper_arm", "clavicle"):
        if ("left", chain) in parts and ("right", chain) in parts:
            left = rest[parts["left", chain][0]] - rest[parts["right", chain][0]]
            break
    else:
        return None
    top = next((parts["", chain][-1] for chain in ("head", "neck", "spine") if ("", chain) in parts), None)
    if top is None:
        return None
    up = rest[top] - rest[parts["", "hips"][0]]
    if np.linalg.norm(np.cross(left, up)) < 1e-6 * np.linalg.norm(left) * np.linalg.norm(up) or not up.any():
        return None
    left = left / np.linalg.norm(left)
    up = up - (up @ left) * left
    up /= np.linalg.norm(up)
    return np.stack([left, up, np.cross(left, up)], axis=1)


def map_joints(
    target: Skeleton, source: Skeleton, changes: Mapping[str, str] | None = None, *, same_names: bool = False
) -> dict[str, str]:
    """Return the joint of the source, a motion's skeleton, that each joint of the target, a body's, follows.

    A joint follows a joint of the same part: the one of the same name where the part has the same names in both
    rigs, in whatever order; else they are matched from the hips outwards, in proportion if two chains differ in
    length. A joint of no known part follows the joint of the same name. Joints without a counterpart are left
    out, and move with their parent. `changes` lead from joints of the target to joints of the source; "" keeps
    one still. With `same_names` joints that would follow one of another name are left out, but for the changes.

    Raises:
        MotionError: A changed joint is not there.
    """
    known = set(source.joint_names)
    ours = {} if known == set(target.joint_names) else find_parts(target)
    theirs = find_parts(source)
    result: dict[str, str] = {}
    for (side, chain), joints in ours.items():
        others = theirs.get((side, chain), [])
        for other in _FALLBACKS.get(chain, ()):
            others = others or theirs.get((side, other), [])
        names = {target.joint_names[joint] for joint in joints}
        if names == {source.joint_names[other] for other in others}:
            result |= {name: name for name in names}
            continue
        for position, joint in enumerate(joints if others else ()):
            share = -(-(position + 1) * len(others) // len(joints)) - 1
            result[target.joint_names[joint]] = source.joint_names[others[share]]
    of_parts = {target.joint_names[joint] for joints in ours.values() for joint in joints}
    result |= {name: name for name in target.joint_names if name in known and name not in of_parts}
    if same_names:
        result = {name: other for name, other in result.items() if name == other}
    for changed, other in (changes or {}).items():
        for name, rig, owner in ((changed, target, "the body"), (other, source, "the motion")):
            if name not in rig.joint_names and (name or rig is target):
                close = difflib.get_close_matches(name, rig.joint_names, n=1)
                first = ", ".join(rig.joint_names[:6])
                hint = f"; did you mean {close[0]}?" if close else f"; it has {first}, ..."
                raise MotionError(f"joint map: {owner} has no joint {name!r}{hint}")
        result[changed] = other
    return {name: result[name] for name in target.joint_names if result.get(name)}
