"""What `rstrack bench` runs of a method: with the depth of later frames fused into its keyframes, and without.

The paper fuses with every method, and so does ours with rolling ones; taken for a global shutter's, lines that are
averaged do not fit together, which helps where images are noisy and harms where they are not. So either may be better.
"""

from __future__ import annotations

from rstrack.options import METHODS

_FUSE, _NO_FUSE = "-fuse", "-no-fuse"


def variants(method: str, fuse: bool | None) -> tuple[str, ...]:
    """Names of what is run of a method, its usual setting first; fuse: the only one that is asked for, None: both.

    The usual setting has the method's own name: fused where the rolling shutter is modelled, else not. Peers and
    added trackers have one variant.
    """
    if method not in METHODS:
        return (method,)
    names = (method, method + (_NO_FUSE if _is_rolling(method) else _FUSE))
    return tuple(name for name in names if fuse is None or fuses(name) == fuse)


def method_of(name: str) -> str:
    """The method of a variant."""
    return name.removesuffix(_NO_FUSE).removesuffix(_FUSE)


def fuses(name: str) -> bool | None:
    """`Options.fuse` of a variant; None: not one of our methods."""
    if method_of(name) not in METHODS:
        return None
    return not name.endswith(_NO_FUSE) and (name.endswith(_FUSE) or _is_rolling(name))


def row_of(name: str) -> str:
    """The line of the tables that a variant competes for.

    Methods that take the rolling shutter for a global one have one for both settings, the better of which is shown, as
    the paper's may have been. A rolling one without fusion has its own, to tell what the shutter does from what fusion
    does.
    """
    return name if _is_rolling(name) else method_of(name)


def _is_rolling(name: str) -> bool:
    return name.startswith("rs-")
