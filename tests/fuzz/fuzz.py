"""Malformed inputs by the thousand: `make fuzz`, or `python tests/fuzz/fuzz.py --cases 2400 --seed 0`.

None of them may run code, hang, end in anything but the package's own errors, or open altered data as whole.
A case is drawn from (seed, kind, number) alone, so that `--only kind:number` makes it again.
"""

import argparse
import collections
import faulthandler
import random
import sys
import tempfile
import time
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(TESTS.parent), str(TESTS)]

import cases  # noqa: E402
import watch  # noqa: E402
from tiny import TINY, tiny_pipeline  # noqa: E402

VIOLATIONS = ("code", "hang", "memory", "traceback", "altered")


def made(folder: Path) -> cases.Workshop:
    """The workshop with a tiny chain of its own."""
    root = folder / "chain"
    pipeline = tiny_pipeline(root)
    for stage in ("simulate", "train", "deploy", "evaluate"):
        pipeline.run(stage)
    (folder / "work").mkdir()
    cases.draw_coarsely()
    return cases.Workshop(folder / "work", root, TINY)


def drawn(shop: cases.Workshop, kind: str, number: int, seed: int) -> tuple[str, str, str]:
    """One case by its name: how it ended, what was said, what it was."""
    draw = random.Random(f"{seed}/{kind}/{number}")
    case = cases.KINDS[kind](shop, draw)
    ending, said = watch.outcome(case.run, case.altered, shop.folder)
    return ending, said, case.what


def main() -> int:
    """Run the cases asked for; 1 if one of them was not refused as it should."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=2400, help="in all, spread over the kinds")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="kinds, or one case of one: kind,kind or kind:number")
    options = parser.parse_args()
    kind, _, number = (options.only or "").partition(":")
    kinds = kind.split(",") if kind else list(cases.KINDS)
    each = -(-options.cases // len(cases.KINDS))
    numbers = [int(number)] if number else range(each)
    endings = {kind: collections.Counter() for kind in kinds}
    with tempfile.TemporaryDirectory() as folder:
        shop, started = made(Path(folder)), time.perf_counter()
        for kind in kinds:
            for at in numbers:
                # A loop that no signal interrupts ends the process, with every thread's place.
                faulthandler.dump_traceback_later(20 * watch.LIMIT, exit=True)
                ending, said, what = drawn(shop, kind, at, options.seed)
                faulthandler.cancel_dump_traceback_later()
                endings[kind][ending] += 1
                if ending in VIOLATIONS or number:
                    print(
                        f"--only {kind}:{at} --seed {options.seed}  {ending}: {said}\n    {what}", flush=True
                    )
        print(f"{'kind':<12} {'refused':>8} {'accepted':>8} {'faults':>8}")
        for kind, counts in endings.items():
            faults = sum(counts[v] for v in VIOLATIONS)
            print(f"{kind:<12} {counts['refused']:>8} {counts['accepted']:>8} {faults:>8}")
        total = sum(endings.values(), collections.Counter())
        print(f"{sum(total.values())} cases in {time.perf_counter() - started:.0f} s: {dict(total)}")
    return int(any(total[v] for v in VIOLATIONS))


if __name__ == "__main__":
    sys.exit(main())
