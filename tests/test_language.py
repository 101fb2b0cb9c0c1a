"""Docstrings of the package: a function's begins with a verb in the third person."""

import ast
import re
from pathlib import Path

import csac_jax

PACKAGE = Path(csac_jax.__file__).parent
QUESTIONS = {"What", "Whether", "Where", "How", "Why", "Which", "Who", "When"}
NOUN = {"of", "that", "which", "are", "and", "by", "for", "from", "with"}  # "Names of", no verb
SHARE = 0.8  # of functions with a docstring


def first_words() -> list[tuple[str, str, str]]:
    """Returns place, first and second word of every function's docstring."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                words = (ast.get_docstring(node) or "").split()
                place = f"{path.relative_to(PACKAGE)}:{node.lineno}"
                found += [(place, words[0], (*words, "", "")[1])] if words else []
    return found


def is_verb(first: str, second: str) -> bool:
    """Returns whether a docstring seems to begin with a verb in the third person."""
    return bool(re.fullmatch(r"[A-Z][a-z]+(?<![sui])s", first)) and second not in NOUN


def test_docstrings_begin_with_a_verb():
    """Claim: at least 80 % of docstrings begin with a verb, and none with a question word."""
    found = first_words()
    assert len(found) > 500
    assert not [place for place, first, _ in found if first.strip(".,:;") in QUESTIONS]
    others = [place for place, *words in found if not is_verb(*words)]
    assert len(others) <= (1 - SHARE) * len(found), others[:20]
