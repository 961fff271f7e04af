"""Replay recorded Blast data: `python -m tests.golden lowlevel|desc|stress FILE.npz`.

Every case goes two ways: through the public library, compared at level 1 (partition,
visible chunks, flags, healths, damage), and through the plain-Python reference,
compared to the last bit and list order, so that no number of a file goes unread. Stress
solves go through the parity solver, compared within float32 noise, and through the
rules around it. An input on which no recorded result depends may be wrong unnoticed.
The last line counts mismatches and, by name, where the library differs from Blast on
purpose or float32 does not decide; the exit code is 0 only if there are no mismatches.
"""

import argparse
import collections
import sys
import time

import numpy as np

from tests import (
    conformance,
    conformance_stress,
    recorded,
    replay,
    replay_stress,
)


def lowlevel(path):
    """Yield (case number, mismatches, differences) of a recording of damage."""
    for case in recorded.lowlevel_cases(path):
        found, differences = conformance.check_lowlevel(case)
        yield case["case_id"], found + replay.verify_lowlevel(case), differences


def desc(path):
    """Yield (case number, mismatches, differences) of a recording of descriptors."""
    for case in recorded.desc_cases(path):
        yield (
            case["desc_id"],
            conformance.check_desc(case) + replay.verify_desc(case),
            {},
        )


def stress(path):
    """Yield the same of a recording of stress solves, and the errors by frame."""
    for case in recorded.stress_cases(path):
        found, differences, errors = conformance_stress.check_stress(case)
        found = found + replay_stress.verify_stress(case)
        yield case["case_id"], found, differences, errors


KINDS = {"lowlevel": lowlevel, "desc": desc, "stress": stress}
QUANTILES = 0.5, 0.9, 0.99, 1.0


def run(kind, path, say=print):
    """Replay a file; return the number of mismatched cases."""
    start = time.perf_counter()
    cases = mismatches = 0
    total = collections.Counter()
    errors = []
    try:
        for number, found, differences, *more in KINDS[kind](path):
            cases += 1
            errors += more[0] if more else []
            mismatches += bool(found)
            total.update(differences)
            for line in found[:5]:
                say(f"case {number}: {line}")
    except Exception as error:
        # A damaged file may break zip, zlib or numpy, and counts that do not add up
        # the cutting into cases.
        mismatches += 1
        say(f"after {cases} cases: {type(error).__name__}: {error}")
    counted = "".join(f", {n} {name}" for name, n in sorted(total.items()))
    size = f"{cases} cases"
    if kind == "stress":
        size += f", {len(errors)} frames"
        _say_quantiles(errors, say)
    seconds = time.perf_counter() - start
    say(f"{kind}: {size}, {mismatches} mismatches{counted}, {seconds:.0f} s")
    return mismatches


def _say_quantiles(errors, say):
    """Print how large the errors of the frames are, by their largest entries."""
    for name, column in zip(
        ("impulse", "stress"), zip(*errors, strict=True), strict=False
    ):
        row = np.quantile(column, QUANTILES)
        text = ", ".join(
            f"{q:.0%} {x:.1e}" for q, x in zip(QUANTILES, row, strict=True)
        )
        say(f"{name} errors of frames: {text}")


def main(arguments=None):
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.golden",
        description="Replay recorded Blast data through blastjax.",
    )
    parser.add_argument("kind", choices=sorted(KINDS), help="what the file records")
    parser.add_argument("file", help="the recording, an npz file")
    options = parser.parse_args(arguments)
    return 1 if run(options.kind, options.file) else 0


if __name__ == "__main__":
    sys.exit(main())
