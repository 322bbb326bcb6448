"""Paths to the objects of data and to their fields, as in the table ``formats.json``.

A path consists of steps with dots between them:

    name    a member; a number is the index of an element
    []      each element of a list (other data counts as a list of one)
    *       each member; in the path of a field, the first one
    ^       at the start: the object one [] or * further out; /: the whole data
    @       the key of the object; within a path, the member with this key
    ~       the first key
    ?k=a+b  the first element whose member k is a or b; >k: the element with the largest member k

"a|b" is the first path that leads to a value.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial
from itertools import islice
from typing import Any, Final

from scene_client.ros_fields import MessageError, number, take

Chain = tuple[tuple[Any, Any], ...]
"""Pairs (key, node): the whole data, then the objects of each [] or * of a path."""

LOOKED_AT: Final = 8
"""Number of elements of each list that show the format of data."""

Step = Callable[[Any, Any], Any]
"""A function of a node and of the key of the object. It returns a part of the node, or None."""


def each(data: Any, path: str, most: int | None = None) -> Iterator[Chain]:
    """Yield the objects of data at the first path of "a|b" that leads to one.

    With ``most``, look only at so many elements of each list.
    """
    for one in path.split("|"):
        found = _each(((None, data),), data, one.split(".") if one else [], most)
        if (first := next(found, None)) is not None:
            yield first
            yield from found
            return


def _each(chain: Chain, node: Any, steps: list[str], most: int | None) -> Iterator[Chain]:
    entries: Any
    for place, step in enumerate(steps):
        if step == "[]":
            is_list = isinstance(node, list | tuple)
            entries = enumerate(node) if is_list else () if node is None else ((0, node),)
        elif step == "*":
            entries = node.items() if isinstance(node, Mapping) else ()
        else:
            node = _step(step)(node, None)
            continue
        for entry in islice(entries, most):
            yield from _each((*chain, entry), entry[1], steps[place + 1 :], most)
        return
    if node is not None:
        yield chain if node is chain[-1][1] else (*chain, (None, node))


def get(chain: Chain, path: str) -> Any:
    """Return the value at the first path of "a|b" that leads to one, or None."""
    for outer, steps in _paths(path):
        key, node = chain[-min(outer, len(chain))]
        for step in steps:
            node = step(node, key if step is _key else chain[-1][0])
            if node is None:
                break
        if node is not None and node != "":
            return node
    return None


@lru_cache(maxsize=1024)
def _paths(path: str) -> list[tuple[int, list[Step]]]:
    """Return pairs (n, steps): the steps of each path start at the nth object from the inside."""
    pairs: list[tuple[int, list[Step]]] = []
    for one in path.split("|"):
        names = one.lstrip("^/").removeprefix(".").split(".")
        outer = sys.maxsize if one[:1] == "/" else 1 + one.count("^")
        if names[-1] == "@":
            pairs.append((outer, [_key]))
        elif "[]" in names:
            place = names.index("[]")
            rest = partial(_inside, ".".join(names[place + 1 :]))
            pairs.append((outer, [*(_step(name) for name in names[:place]), rest]))
        else:
            pairs.append((outer, [_step(name) for name in names if name]))
    return pairs


@lru_cache(maxsize=1024)
def _step(step: str) -> Step:
    if step[:1] == ">":
        return partial(_largest, step[1:])
    if step[:1] == "?":
        name, _, wanted = step[1:].partition("=")
        return partial(_with, name, wanted.split("+"))
    if step in ("*", "~"):
        return partial(_first, step == "*")
    return _of_key if step == "@" else partial(_member, step)


def _member(name: str, node: Any, _: Any) -> Any:
    if isinstance(node, list | tuple):
        return node[int(name)] if name.isdecimal() and int(name) < len(node) else None
    return take(node, name)


def _of_key(node: Any, key: Any) -> Any:
    return take(node, key)


def _key(_: Any, key: Any) -> Any:
    return key


def _inside(path: str, node: Any, _: Any) -> Any:
    entries = node if isinstance(node, list | tuple) else ()
    return [get(((None, entry),), path) for entry in entries]


def _first(is_value: bool, node: Any, _: Any) -> Any:
    pairs = node.items() if isinstance(node, Mapping) else ()
    return next((pair[is_value] for pair in pairs), None)


def _with(name: str, wanted: list[str], node: Any, _: Any) -> Any:
    entries = node if isinstance(node, list | tuple) else ()
    return next((one for one in entries if str(take(one, name)) in wanted), None)


def _largest(name: str, node: Any, _: Any) -> Any:
    if not isinstance(node, list | tuple):
        raise MessageError(f"the {name}s must be in a list")
    best, most = None, -math.inf
    for one in node:
        # The layout of the results of vision_msgs differs between versions of ROS.
        rank = number(take(take(one, "hypothesis") or one, name))
        if rank is not None and rank > most:
            best, most = one, rank
    return best


def leads(path: str, data: Any) -> bool:
    """Return whether a path leads to a value. The path may end in "=value"."""
    path, _, wanted = path.partition("=")
    chain = next(each(data, path, LOOKED_AT), None)
    return chain is not None and (not wanted or str(chain[-1][1]) == wanted)
