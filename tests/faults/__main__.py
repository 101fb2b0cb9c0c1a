"""Injects all faults, or those whose names hold one of the arguments.

    python -m tests.faults [--seed N] [NAME ...]

Prints the table; all faults together, without a seed, write it into docs/reliability.md. Exits with
1 if a try went wrong.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_ENABLE_COMPILATION_CACHE", "0")

import csac_jax  # noqa: F401  (before JAX: it sets up the thread pool)

from tests.faults import harness  # isort: skip

PAGE = harness.ROOT / "docs/reliability.md"
BEGIN, END = "<!-- faults: begin -->", "<!-- faults: end -->"


def main(names: list[str], seed: int | None) -> int:
    faults = harness.load()
    chosen = [one for one in faults.values() if not names or any(n in one.name for n in names)]
    tallies: list[tuple[str, harness.Tally]] = []
    for one in chosen:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="csac-jax-faults-") as folder:
            try:
                tally = harness.run(one, one.tries, Path(folder), seed)
            except harness.MissingToolError as error:
                print(f"{one.name}: not tried, {error}", flush=True)
                continue
        tallies.append((one.name, tally))
        print(f"{one.name}: {tally.tries} tries, {tally.bad} bad", end=", ")
        print(f"{time.monotonic() - begun:.0f} s", flush=True)
        for remark in tally.remarks:
            print(f"  {remark}", flush=True)
    text = harness.table(tallies)
    print(text, end="")
    if len(tallies) == len(faults) and seed is None:
        PAGE.write_text(with_table(PAGE.read_text(), text))
    return int(any(tally.bad for _, tally in tallies))


def with_table(page: str, text: str) -> str:
    (before, _), (_, after) = page.split(BEGIN), page.split(END)
    return f"{before}{BEGIN}\n{text}{END}{after}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*")
    parser.add_argument("--seed", type=int)
    given = parser.parse_args()
    sys.exit(main(given.names, given.seed))
