"""Rows of ``crazysim validate`` as JSON lines, one section or several.

python benchmarks/validation.py closed mujoco [--data FOLDER] [--policy FILE_OR_FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from measure import report, round_digits

from crazysim.lab.validate import NAMES, validate
from crazysim.lab.validate.page import bound_text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="+", choices=NAMES)
    parser.add_argument("--data", type=Path, help="folder with logs of real flights, and for trained policies")
    parser.add_argument("--policy", type=Path, help="policy to compare with RAPTOR; by default that of the package")
    args = parser.parse_args()
    for row in validate(args.data, args.sections, args.policy):
        if row.problem:
            raise SystemExit(f"{row.quantity}: {row.problem}")
        line = {"figure": round_digits(row.figure), "unit": row.unit, "passes": bound_text(row.bound)}
        report("cpu", quantity=row.quantity, reference=row.reference, **line, remark=row.remark)


if __name__ == "__main__":
    main()
