"""``crazysim airframe``: airframes from a few numbers, and their checks."""

from __future__ import annotations

import argparse
from pathlib import Path

from crazysim.commands.options import DefaultsFormatter, number, size
from crazysim.errors import require
from crazysim.storage import check_writable, write_file

ESTIMATE_OPTIONS = (
    "mass", "propeller", "arm", "n_rotors", "layout", "thrust_to_weight", "motor_table", "pitch", "inertia",
    "time_constant", "cells", "capacity", "resistance",
)  # fmt: skip
"""Options of ``new`` that are arguments of ``estimate_airframe``."""
SPIN_SIGNS = {"ccw": 1, "cw": -1}
"""Sign of each sense of rotation, seen from above."""


def add_parsers(commands: argparse._SubParsersAction) -> None:
    airframe = commands.add_parser("airframe", help="make an airframe from a few numbers, or check one")
    actions = airframe.add_subparsers(title="actions", metavar="ACTION", dest="action", required=True)
    parser = actions.add_parser(
        "new",
        help="estimate an airframe from mass, rotors and thrust; write a TOML file with a source for every number",
        epilog="example: crazysim airframe new mine.toml --mass 1.2 --arm 0.12 --propeller 0.127 --thrust-to-weight 4",
        formatter_class=DefaultsFormatter,
    )
    parser.set_defaults(run=estimate)
    add = parser.add_argument
    add("file", type=Path, help=".toml file to write")
    add("--mass", type=size(1.2), required=True, metavar="KG", help="mass with the battery")
    add("--propeller", type=size(0.127), required=True, metavar="M", help="diameter of the propellers")
    add("--arm", type=size(0.12), metavar="M", help="distance of the rotors from the centre")
    add(
        "--rotors", type=number(example=4), default=4, dest="n_rotors", metavar="N", help="number of rotors on a circle"
    )
    add("--layout", default="x", choices=("x", "+"), help="nose between two rotors, or on the first rotor")
    positions_help = "rotors from the centre of mass, m, instead of --arm: X,Y or X,Y,Z each"
    add("--positions", metavar="'X,Y ...'", help=positions_help)
    spins_help = "sense of rotation of each rotor seen from above; by default they alternate from ccw"
    add("--spins", nargs="+", metavar="CCW|CW", help=spins_help)
    add("--thrust-to-weight", type=size(4), metavar="RATIO", help="largest thrust of all rotors over weight")
    motor_table_help = (
        "data sheet of one motor with its propeller instead of --thrust-to-weight, .csv with columns thrust_g or "
        "thrust_n, and if known rpm, torque_nm, power_w"
    )
    add("--motor-table", type=Path, metavar="FILE", help=motor_table_help)
    add("--pitch", type=size(0.06), metavar="M", help="pitch of the propellers; by default half the diameter")
    add("--inertia", type=size(0.001), nargs=3, metavar="KGM2", help="moments of inertia; by default estimated")
    add("--time-constant", type=size(0.03), metavar="S", help="time constant of the rotors; by default estimated")
    add("--cells", type=number(example=4), metavar="N", help="battery cells in series; by default estimated")
    add("--capacity", type=size(1.5), metavar="AH", help="charge of the battery, A h; by default estimated")
    add("--resistance", type=size(0.02), metavar="OHM", help="resistance of the whole battery; by default estimated")
    add("--name", help="name of the airframe; by default the file's")

    text = "print what an airframe can do and what it lacks, and draw it"
    parser = actions.add_parser("check", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=check)
    parser.add_argument("file", help="path of a .toml file, or the name of a built-in airframe")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="picture of the body to write, .png")


def estimate(options: argparse.Namespace) -> None:
    """Estimate an airframe, and write its file."""
    import tomllib

    from crazysim.drones import estimate_airframe, load_airframe

    path: Path = options.file
    check_writable(path, (".toml",))
    require(
        not path.exists(),
        f"expected a new file, got {str(path)!r}, which exists; choose another name or remove it",
        ValueError,
    )
    if unknown := [x for x in options.spins or () if x.lower() not in SPIN_SIGNS]:
        raise ValueError(f"expected --spins of ccw and cw, got {unknown[0]!r}")
    try:
        texts = (options.positions or "").split()
        positions = [[float(x) for x in f"{coordinates},0".split(",")][:3] for coordinates in texts] or None
    except ValueError:
        raise ValueError(f"expected --positions such as '0.1,-0.1 0.1,0.1', got {options.positions!r}") from None
    text = estimate_airframe(
        **{name: getattr(options, name) for name in ESTIMATE_OPTIONS},
        positions=positions,
        spins=options.spins and [SPIN_SIGNS[x.lower()] for x in options.spins],
        name=options.name or path.stem,
    )
    tables = tomllib.loads(text)
    load_airframe(tables)
    write_file(path, text)
    estimates = [key for key, source in tables["sources"].items() if source.startswith("estimate: ")]
    print(f"wrote {path}; estimated: {', '.join(estimates)}")
    print(f"next: crazysim airframe check {path} --picture {path.with_suffix('.png')}")


def check(options: argparse.Namespace) -> None:
    """Describe an airframe, and draw it."""
    from crazysim.commands.airframe_check import describe_airframe, draw_airframe
    from crazysim.drones import load_airframe

    if options.picture is not None:
        check_writable(options.picture, (".png",))
    airframe = load_airframe(options.file)
    print(describe_airframe(airframe))
    if options.picture is not None:
        draw_airframe(airframe, options.picture)
        print(f"wrote {options.picture}")
