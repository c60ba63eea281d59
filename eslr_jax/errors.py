"""Errors a user can act on, and the status bits that travel through jitted code."""

from __future__ import annotations

import enum


class EslrError(Exception):
    """Base of every error raised on purpose; its text is one line: the cause, then the remedy."""


class AssetError(EslrError):
    """A file or a bundled asset is missing, unreadable, or can't be written."""


class MeshError(EslrError):
    """A mesh can't be simulated as it is."""


class MotionError(EslrError):
    """A motion is empty, not finite, or made for another skeleton."""


class ConfigError(EslrError):
    """A configuration value is unknown, impossible, or contradicts another."""


class CapacityError(EslrError):
    """A fixed-size buffer is too small; the message names the size needed."""


class NonFiniteError(EslrError):
    """A simulation or a training produced NaN or infinity."""


class CheckpointError(EslrError):
    """A checkpoint is damaged, or was made for another model or a newer format."""


class MissingExtraError(EslrError):
    """An optional dependency is not installed; the message names the extra."""


class Status(enum.IntFlag):
    """What went wrong inside a jitted rollout; bits of `ClothState.status`."""

    OK = 0
    NON_FINITE = 1
    SELF_CONTACT_OVERFLOW = 4
    BODY_TOO_FAST = 8
    DERIVATIVE_REFUSED = 16

    def describe(self) -> str:
        """One line per set bit, with what to do about it."""
        texts = {
            Status.NON_FINITE: "positions or forces became NaN or infinite; use the solver, more iterations, "
            "or a smaller timestep",
            Status.SELF_CONTACT_OVERFLOW: "more self-contact than its buffers hold; "
            "give the term Contact more rows",
            Status.BODY_TOO_FAST: "the body moved farther in one frame than contacts can follow; "
            "slow the motion down, or pose it with more frames a second",
            Status.DERIVATIVE_REFUSED: "the frame did not come to rest in a minimum, so its derivative is NaN; "
            "give SimConfig more iterations, or a fabric that bends less",
        }
        return "; ".join(text for bit, text in texts.items() if bit in self)
