"""What moved since the ratios of benchmarks/baseline.json were written: ``make bench``.

    python benchmarks/baseline.py [--out out/bench] [--threads N] [--update]

Runs ``difflpv bench --quick`` (what was measured by this code is found again) and compares ratios: no time by itself, so that
the file holds on any machine. Ratios of a busy machine still move; look twice before believing one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from difflpv.bench.baseline import compare, ratios, read_baseline
from difflpv.bench.run import run_bench
from difflpv.bench.settings import BenchSettings
from difflpv.io.atomic import write_json

BASELINE = Path(__file__).with_name("baseline.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--update", action="store_true", help="write the ratios of this run to baseline.json")
    options = parser.parse_args()
    found = ratios(run_bench(options.out, settings=BenchSettings.of_quick(), threads=options.threads))
    lines = compare(read_baseline(BASELINE), found)
    print("\n".join(lines) if lines else f"none of {len(found)} ratios moved by more than a fifth")
    if options.update:
        write_json(BASELINE, dict(sorted(found.items())))


if __name__ == "__main__":
    main()
