"""A digest inside a result, by which a changed file is noticed. Needs no JAX."""

import hashlib
import json
from typing import Any

SHA256 = "sha256"  # key of the digest


def seal(content: dict[str, Any]) -> dict[str, Any]:
    """Returns a JSON object with the digest of all else in it."""
    plain = json.loads(json.dumps(content))  # as it is read back
    return {**plain, SHA256: digest(plain)}


def digest(content: dict[str, Any]) -> str:
    """Computes the SHA-256 digest of an object without its digest, as JSON in UTF-8 with sorted
    keys and without spaces."""
    rest = {key: value for key, value in content.items() if key != SHA256}
    return hashlib.sha256(
        json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def is_intact(content: dict[str, Any]) -> bool:
    """Returns True for an object that fits its digest, or has none."""
    return content.get(SHA256, digest(content)) == digest(content)
