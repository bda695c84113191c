#!/usr/bin/env python3
"""Compares the time of this detector with that of the reference detectors, on the same frames, in one run.

    python3 tools/experiments/compare_speed.py COMMAND FOLDER [ROUNDS]

COMMAND runs the experiment: the path of `alight`, which is called as `alight experiment markers`. Rounds of ours and
theirs alternate, all on one thread; of each frame the shortest processor time of all rounds counts, of the frames the
median. Exit status: 1 when a ratio misses its bar, 0 otherwise and when a reference is not installed.
"""

import json
import pathlib
import statistics
import subprocess
import sys

import references

# The maximum ratio of our time to theirs.
BARS = [
    ("rings", "thesis-rings", 1 / 3),
    ("apriltag-16h5", "opencv", 1 / 2.5),
    ("apriltag-16h5", "apriltag", 1 / 12),
    ("apriltag-36h11", "opencv", 1 / 2.5),
    ("apriltag-36h11", "apriltag", 1 / 12),
    ("aruco-4x4-50", "opencv", 1 / 2.5),
    ("stag-hd23", "stag", 1.0),
]
FAMILIES = ["rings", "apriltag-16h5", "aruco-4x4-50", "stag-hd23", "apriltag-36h11"]
MAX_MS = {"alight-all": 8.0, "alight-following": 0.15}


def times(results, detector, name, family):
    """Processor time of each frame in milliseconds; none without the detector."""
    path = results / detector / name / f"{family}.jsonl"
    if not path.is_file():
        return None
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    # A follower has nothing to follow in the first frame.
    return [line["ms"] for line in lines][1 if detector == "alight-following" else 0 :]


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    command, folder = sys.argv[1], pathlib.Path(sys.argv[2])
    rounds = int(sys.argv[3]) if len(sys.argv) > 3 else 3
    best = {}
    for _ in range(rounds):
        asked = ["experiment", "markers", "--output", str(folder), "--set", "textured", "--set", "tracking"]
        subprocess.run([command, *asked], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        results = folder / "results"
        for family in FAMILIES:
            for kind in references.DETECTORS:
                if kind.takes(family):
                    sets = folder / "sets" / "textured" / family
                    references.run_set(sets, results, "textured", family, kind(family))
        detectors = ["alight", "alight-all", "alight-following"] + [kind.name for kind in references.DETECTORS]
        for detector in detectors:
            name = "tracking" if detector == "alight-following" else "textured"
            for family in FAMILIES:
                now = times(results, detector, name, family)
                if now is not None:
                    before = best.get((detector, family), now)
                    best[detector, family] = [min(pair) for pair in zip(before, now)]
    medians = {key: statistics.median(values) for key, values in best.items()}
    is_met = True
    print("\n| marker | ours ms | reference | its ms | ratio | bar |\n|---|---|---|---|---|---|")
    for family, reference, bar in BARS:
        ours, theirs = medians.get(("alight", family)), medians.get((reference, family))
        if ours is None or theirs is None:
            print(f"| {family} | {ours} | {reference} | not installed | | |")
            continue
        is_met &= ours / theirs <= bar
        print(f"| {family} | {ours:.2f} | {reference} | {theirs:.2f} | 1/{theirs / ours:.1f} | 1/{1 / bar:.1f} |")
    for detector, bar in MAX_MS.items():
        for family in FAMILIES:
            if (detector, family) in medians:
                ours = medians[detector, family]
                is_met &= ours <= bar
                print(f"| {family} | {ours:.3f} | {detector} | | | {bar} ms |")
    sys.exit(0 if is_met else 1)


if __name__ == "__main__":
    main()
