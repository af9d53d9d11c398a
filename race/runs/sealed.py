"""JSON that people and disks may have changed: read without surprises, and sealed with a digest."""

import hashlib
import json
from typing import Any

_SEAL = "digest"


class BrokenSealError(ValueError):
    """The content is not what was written."""


def parse(text: str | bytes) -> Any:
    """The value of a JSON text.

    Raises:
        ValueError: if it is none, or nested so deeply that nobody meant it.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def parse_object(text: str | bytes) -> dict[str, Any]:
    """The object that is a JSON text.

    Raises:
        ValueError: if it is none.
    """
    value = parse(text)
    if not isinstance(value, dict):
        raise ValueError(f"it is a {type(value).__name__} and no object")
    return value


def seal(body: dict[str, Any]) -> dict[str, Any]:
    """The same with a digest of its content, whatever the order and the spaces of its text."""
    return {**body, _SEAL: digest(body)}


def unseal(body: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """The content without the digest, and whether there was one.

    Raises:
        BrokenSealError: if the digest is that of another content.
    """
    content = {key: value for key, value in body.items() if key != _SEAL}
    if _SEAL not in body:
        return content, False
    if body[_SEAL] != digest(content):
        raise BrokenSealError("its digest is that of another content")
    return content, True


def digest(body: Any) -> str:
    """A digest of a JSON value, as 32 hex digits."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
