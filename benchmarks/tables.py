"""Markdown tables of the JSON lines of benchmarks, as ``figures.py`` writes them into the pages.

A line has the name of its figure and its machine, such as ``H100``, besides what the benchmark printed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from measure import round_digits

Line = dict[str, Any]
"""JSON line of a benchmark, or record of a figure: its name, its machine, its lines, ..."""


def pivot(
    lines: list[Line],
    row: Callable[..., str],
    column: Callable[..., str],
    value: Callable[..., str],
    corner: str,
    rows: Iterable[str] | None = None,
) -> str:
    """Return a Markdown table with a cell for each line.

    Args:
        lines: The lines.
        row: Function from a line to the name of its row.
        column: Function from a line to the name of its column.
        value: Function from a line to the text of its cell.
        corner: Heading of the names of rows.
        rows: Names of all rows in order; by default, that of the lines.
    """
    cells = {(row(line), column(line)): value(line) for line in lines}
    columns = list(dict.fromkeys(name for _, name in cells))
    rows = dict.fromkeys(name for name, _ in cells) if rows is None else rows
    return markdown_table([corner, *columns], [[name, *(cells.get((name, x), "") for x in columns)] for name in rows])


def markdown_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def columns(**getters: Callable[[Line], str]) -> Callable[[list[Line]], str]:
    """Return a function that makes a table with a row for each line. Underscores in names become spaces in headings."""
    head = [name if name.startswith("`") else name.replace("_", " ") for name in getters]
    return lambda lines: markdown_table(head, [[get(line) for get in getters.values()] for line in lines])


LEVELS = {"rotor_vel": "rotor speeds", "attitude": "attitude", "state": "state"}
"""Text of each command level."""
INTEGRATORS = {"euler": "Euler", "rk4": "RK4"}
"""Text of each integrator."""


def case_text(line: Line) -> str:
    """Return command level, integrator and controller of a line as text."""
    parts = [LEVELS[line["control"]], *([INTEGRATORS[line["integrator"]]] if "integrator" in line else [])]
    return ", ".join(
        [*parts, *([f"`{line['controller']}`"] if "controller" in line and line["control"] != "rotor_vel" else [])]
    )


def worlds_text(line: Line) -> str:
    return f"{line['n_worlds']:,}"


def si_text(value: float) -> str:
    """Return a number with three digits and a prefix, such as ``46.2 G``."""
    value, k = round_digits(value), 0
    while value >= 1000 and k < 3:
        value, k = round_digits(value / 1000), k + 1
    return f"{value:g} {' kMG'[k]}".strip()


def duration_text(seconds: float) -> str:
    """Return a duration with three digits and its unit."""
    factor, unit = next(((f, u) for f, u in ((1, "s"), (1e3, "ms"), (1e6, "us")) if seconds * f >= 1), (1e9, "ns"))
    return f"{round_digits(seconds * factor):g} {unit}"


def machine_of(line: Line) -> str:
    return line["machine"]


def loops(lines: list[Line]) -> str:
    """Return times of an iteration, followed by the ratio of Crazyflow's time to ours if it was measured."""

    def time_of(line: Line) -> str:
        if "ratio" in line:
            return f"{duration_text(line['crazysim_call_s'])}, {round_digits(line['ratio'], 2):g}"
        return duration_text(line["iteration_s"])

    names = {"loop/jax": "one compiled addition, with its result in NumPy", "loop/mj_step": "C MuJoCo, one box"}

    def row_of(line: Line) -> str:
        case = names[line["benchmark"]] if line["benchmark"] in names else case_text(line).replace(", Euler", "")
        return f"{line['machine']}: {case}"

    return pivot(lines, row_of, worlds_text, time_of, "Commands, worlds")


def rates(lines: list[Line]) -> str:
    """Return steps per second of the default controller by number of worlds, and the shares of the highest rates."""
    lines = [
        x for x in lines if "control" in x and (x["control"] == "rotor_vel" or x.get("controller", "auto") == "auto")
    ]

    def row_of(line: Line) -> str:
        case = f"{LEVELS[line['control']]}, {INTEGRATORS[line['integrator']]}"
        return case + ", every parameter differs" * line.get("randomised", False)

    return pivot(
        lines,
        row_of,
        lambda x: "share of the limit" if x["name"] == "limits" else worlds_text(x),
        lambda x: f"{1 / x['ratio']:.0%}" if x["name"] == "limits" else si_text(x["steps_per_s"]),
        "Commands, worlds",
    )


def versus(lines: list[Line]) -> str:
    """Return rates, times and memory of crazysim and Crazyflow, their ratio, and the times of compilation.

    Of the steps it has the most worlds of each machine, with the Euler method.
    """
    steps = "versus_crazyflow/step"
    largest = {
        x["machine"]: x["n_worlds"]
        for x in sorted(lines, key=lambda x: x.get("n_worlds", 0))
        if x["benchmark"] == steps
    }
    lines = [
        x
        for x in lines
        if x["benchmark"] != steps or (x["n_worlds"] == largest[x["machine"]] and x["integrator"] == "euler")
    ]
    names = {
        "contacts": "contacts after a step, 4,096 worlds of 4 drones, 8 objects",
        "depth": "64 x 64 depth of 1,024 worlds, 8 objects",
        "swarm_build": "`Sim(n_drones=1024)`",
        "gym": "100 steps of the Gymnasium environment, 4,096 worlds",
    }

    def row_of(line: Line) -> list[str]:
        name = line["benchmark"].partition("/")[2]
        ratio = line["ratio"]
        if name == "memory":
            label, ratio = f"memory of a world after a contact query, drones: {line['n_drones']}", 1 / ratio
            values = [f"{round_digits(line[f'{x}_bytes_per_world'] / 1000):g} kB" for x in ("crazysim", "crazyflow")]
        elif name in names:
            label = names[name]
            values = [duration_text(line[f"{x}_s"]) for x in ("crazysim", "crazyflow")]
        else:
            prefix = "gradient of 100 steps, " if name == "gradient" else ""
            label = f"{prefix}{case_text(line).replace(', Euler', '')}, {worlds_text(line)} worlds"
            values = [si_text(line[f"{x}_steps_per_s"]) for x in ("crazysim", "crazyflow")]
        seconds = [f"{line[f'{x}_compile_s']:.2g} s" for x in ("crazysim", "crazyflow") if name in ("step", "gradient")]
        return [line["machine"], label, *values, f"{round_digits(ratio, 2):g}", ", ".join(seconds)]

    return markdown_table(
        ["Machine", "Steps per second, time or memory", "crazysim", "Crazyflow", "Ratio", "Compilation"],
        [row_of(line) for line in lines],
    )


def gradients(lines: list[Line]) -> str:
    """Return rates of gradients, and the ratios of their times to the times of the steps alone."""
    return columns(
        Machine=machine_of,
        Commands=lambda x: LEVELS[x["control"]],
        Worlds=worlds_text,
        Steps_per_second=lambda x: si_text(x["n_worlds"] * x["n_steps"] / x["gradient_s"]),
        Over_steps_alone=lambda x: f"{x['forward_passes']:.2g}",
        Forward_mode_over_steps_alone=lambda x: f"{x['jvp_passes']:.2g}",
        First_gradient_compiles_in=lambda x: f"{x['compile_s']:.2g} s",
    )([line for line in lines if line["machine"] != "H100" or line["n_worlds"] == 131072])


def env_rates(lines: list[Line]) -> str:
    """Return environment steps per second by task and actions, and ratios with and without randomised drones."""
    names = {"random": "random actions", "policy": "a 64 x 64 policy", "training": "iterations of PPO"}

    def row_of(line: Line) -> str:
        image = f", a depth image of {line['depth'][0]} x {line['depth'][1]}" if line["depth"] else ""
        randomized = ": `Randomize.crazyflie()` over none" if "without" in line else ""
        return f"{line['machine']}: `{line['task']}`, {names[line['actions']]}{image}{randomized}"

    key = ("name", "machine", "actions", "n_worlds")
    plain = {tuple(x[k] for k in key): x["env_steps_per_s"] for x in lines if x["drones"] != "randomized"}
    shown = [x for x in lines if x["name"] != "randomize"] + [
        x | {"without": plain[tuple(x[k] for k in key)]} for x in lines if x["drones"] == "randomized"
    ]
    shown = sorted(shown, key=lambda x: x["n_worlds"])
    order = {row_of(x): None for x in sorted(shown, key=lambda x: ("without" in x, x["machine"] != "Xeon"))}
    return pivot(
        shown,
        row_of,
        worlds_text,
        lambda x: f"{x['env_steps_per_s'] / x['without']:.2f}" if "without" in x else si_text(x["env_steps_per_s"]),
        "Environment steps/s, worlds",
        list(order),
    )


def poles_text(line: Line) -> str:
    return f"{line['n_poles']:,} {'movable' if line['movable'] else 'fixed'} poles" if line["n_poles"] else "none"


def depths(lines: list[Line]) -> str:
    """Return rates of depth images and times of steps with range finders, each with the time of the first."""
    lines = [x for x in lines if x["n_poles"] in (0, 30, 1000)]
    heads = {"depth": "64 x 64 depth, rays/s", "range_finder": "`RangeFinder`, one step"}

    def cell(line: Line) -> str:
        rays = si_text(line["rays_per_s"]) if "rays_per_s" in line else duration_text(1e-6 * line["step_us"])
        return f"{rays}, {duration_text(line['first_s'])}"

    return pivot(
        sorted(lines, key=lambda x: (x["n_poles"], x["machine"] == "H100")),
        poles_text,
        lambda x: f"{heads[x['benchmark']]}: {x['machine']}, {worlds_text(x)} worlds",
        cell,
        "Poles",
    )


def colors(lines: list[Line]) -> str:
    """Return images per second, of depth and in colour; of a CPU per second of one core."""
    return pivot(
        lines,
        lambda x: f"{x['images']}, {poles_text(x)}",
        lambda x: f"{'one core of ' * ('images_per_processor_s' in x)}{x['machine']}, {worlds_text(x)} worlds",
        lambda x: si_text(x.get("images_per_processor_s", x["images_per_s"])),
        "64 x 64 pixels, images/s",
    )


maps = columns(
    Rooms=lambda x: (
        "one for all worlds, mean of eight" if x["n_maps"] == 1 else f"{x['n_maps']}, one drawn by each world"
    ),
    Machine=lambda x: f"{'one core' if 'images_per_processor_s' in x else x['machine']}, {worlds_text(x)} worlds",
    Depth_images_per_second=lambda x: si_text(x.get("images_per_processor_s", x["images_per_s"])),
    Contact_reports_per_second=lambda x: si_text(x.get("contacts_per_processor_s", x["contacts_per_s"])),
    Tables_of_rays=lambda x: f"{si_text(x['table_bytes'])}B",
    First_calls=lambda x: duration_text(x["first_s"]),
)
"""Rates among rooms that differ, and among equal ones; of a CPU per second of one core."""


def costs(lines: list[Line]) -> str:
    """Return the times of cases divided by the times of their references, rates of the cases, and first calls."""
    return pivot(
        lines,
        lambda x: f"`{x['case']}` over `{x['reference']}`",
        machine_of,
        lambda x: f"{x['ratio']:.3g}, {si_text(x['steps_per_s'])}, {duration_text(x['first_s'])}",
        "Case: time over reference, steps per second, first call",
    )


path_errors = columns(
    Controller=lambda x: f"`{x['controller']}`",
    **{
        f"`{vehicle}`": lambda x, v=vehicle: f"{', '.join(f'{100 * e:.1f}' for e in x['errors'][v])} cm"
        for vehicle in ("f1tenth_ros", "aiml_head")
    },
)
"""Largest errors of each controller with two models of cars, one for each speed of ``vehicles.py --errors``."""


def ratios(lines: list[Line]) -> str:
    """Return the times of cases divided by the times of their references, a row for each reference."""
    cells: dict[tuple[str, str], list[str]] = {}
    for x in lines:
        if x["case"] != x["reference"]:
            cells.setdefault((x["machine"], f"`{x['reference']}`"), []).append(f"`{x['case']}` {x['ratio']:.3g}")
    rows = [[*key, ", ".join(texts)] for key, texts in sorted(cells.items(), key=lambda item: item[0][1])]
    return markdown_table(["Machine", "Reference", "Time of each case over it"], rows)


def racing(lines: list[Line]) -> str:
    """Return published and planned times of flights over race tracks, by the time between changes of thrust."""

    def row_of(x: Line) -> tuple[str, ...]:
        floor = "none" if x["floor"] is None else f"{x['floor']:g} m"
        lag = ", rotor lag" if x["rotor_lag"] else ""
        return f"`{x['track']}`", f"`{x['drone']}`{lag}", f"{x['yaw_rate']:g} rad/s, {floor}", x["published"]

    cells: dict[tuple[str, ...], dict[float, str]] = {}
    for x in lines:
        if x["case"] == "plan":
            text = f"{x['duration_s']:.2f} s; {x['deviation_cm']:.2g} cm; {x['cpu_s']:.2g} s"
            cells.setdefault(row_of(x), {})[x["dt"]] = text
    head = ["Track", "Drone", "Yaw rate, floor", "Published", "0.04 s: time; deviation; planning", "0.02 s"]
    return markdown_table(head, [[*row, *(by_dt.get(dt, "") for dt in (0.04, 0.02))] for row, by_dt in cells.items()])


def sagging(lines: list[Line]) -> str:
    return columns(
        At_full_thrust_for=lambda x: f"{x['seconds']} s",
        Voltage=lambda x: f"{x['voltage']:g} V",
        Thrust=lambda x: f"{x['thrust']:g} N",
        Plan=lambda x: f"{x['duration_s']:.2f} s",
    )([x for x in lines if x["case"] == "battery"])


def further(lines: list[Line]) -> str:
    """Return machine, what is measured, and the figure, for measurements with few lines."""
    images = {"policy": "`forest` with its convolution, 4,096 worlds", "lidar": "a lidar of 16 x 360 rays at 10 Hz"}
    fleet = {
        "cars": "four drones and two cars, over the drones alone",
        "airframes": "two airframes, over one with parameters per drone",
    }
    first = {
        "step": "step",
        "gradient": "gradient of 100 steps, 64 worlds of 2 drones",
        "contacts": "step and `contacts()`, 64 worlds of 2 drones",
        "gymnasium": "Gymnasium: make, reset, step",
        "render": "`render`",
    }

    def row_of(x: Line) -> tuple[str, str]:
        name = x["name"]
        if name == "coupled":
            rates = (si_text(x["steps_per_s"][key]) for key in ("downwash", "uncoupled"))
            return f"{x['n_drones']} drones in a world, with and without downwash", f"{', '.join(rates)} steps/s"
        if name == "sight":
            is_policy = x["case"] == "policy"
            rate = f"{si_text(x['env_steps_per_s'])} steps/s" if is_policy else f"{x['realtime']:g} times real time"
            return images[x["case"]], f"{rate}, {si_text(x['rays_per_s'])} rays/s, first {duration_text(x['first_s'])}"
        if name == "vehicles":
            return "one car in a world, steps/s", f"`{x['case']}` {si_text(x['steps_per_s'])}"
        if name == "fleets":
            return f"rate of the drones: {fleet[x['case']]}", f"{round_digits(x['ratio'], 2):g}"
        if name == "mppi":
            compilation = duration_text(x["compile_s"])
            return f"MPPI, {x['samples']:,} samples", f"{si_text(x['commands_per_s'])} commands/s, first {compilation}"
        if name == "live":
            late = f"late by {x['lateness_999_ms']:g} ms in 999 of 1000 steps, {x['worst_ms']:g} ms at worst"
            return f"live, {x['n_drones']} drones, `{x['case']}`", f"{x['factor']:g} times real time, {late}"
        if name == "mocap":
            figures = f"{x['frame_ms']:g} ms a frame, {x['update_ms']:g} ms an update, {x['lost']} lost"
            return f"motion capture, {x['n_objects']} objects at {x['freq']:g} Hz", figures
        seconds = f"{x['wall_s']:.1f} s" + (" with `CRAZYSIM_CACHE=off`" if x["cache"] == "off" else " in a second run")
        return f"first result: {first[x['case']]}", seconds

    cells: dict[tuple[str, str], list[str]] = {}
    for line in lines:
        text, figure = row_of(line)
        cells.setdefault((line["machine"], text), []).append(figure)
    return markdown_table(["Machine", "", ""], [[*key, ", ".join(figures)] for key, figures in cells.items()])


def control(lines: list[Line]) -> str:
    """Return the flights of all controllers with all airframes.

    The docstring of ``controllers.py`` defines the entries of a line, such as ``home``, the fraction of the flights
    from random attitudes that return to the setpoint, and ``lost_178``, the height that a drone loses from a roll of
    178 degrees. A rate of ``levels`` means that the controller levels the drone instead of following a command of body
    rates.
    """

    def metres(value: float | None) -> str:
        return "" if value is None else "< 0.001" if value < 0.001 else f"{value:.3f}"

    def percent(value: float | None) -> str:
        return "" if value is None else "< 1%" if value < 0.01 else f"{value:.0%}"

    def row_of(line: Line) -> list[str]:
        lost_height = line.get("lost_178")
        rate = "levels" if line.get("error_body_rate", 0) > 0.5 else percent(line.get("overshoot_body_rate"))
        return [
            f"`\"{line['controller']}\"`", f"`{line['drone']}`",
            *(metres(line.get(key)) for key in ("hover", "tracking", "pushed", "heavier")),
            "" if "home" not in line else f"{line['home']:.0%}",
            "" if lost_height is None else "all" if lost_height > 99 else f"{lost_height:.1f}",
            percent(line.get("overshoot_attitude")), rate,
        ]  # fmt: skip

    head = (
        "`controller`",
        "Drone",
        "Hover, m",
        "Eight, m",
        "Pushed, m",
        "Heavier, m",
        "Home",
        "Lost, m",
        "Attitude",
        "Rate",
    )
    auto = [x for x in lines if x["controller"] == "auto"]
    largest = {key: max(x[key] for x in auto if key in x) for key in auto[0] if isinstance(auto[0][key], float)}
    worst = largest | {"controller": "auto", "home": min(x["home"] for x in auto)}
    rows = [row_of(worst | {"drone": f"worst of {len(auto)}"})]
    rows[0][1] = rows[0][1].strip("`")
    return markdown_table(head, rows + [row_of(x) for x in lines if x["drone"] == "cf21B_500"])


def control_rates(lines: list[Line]) -> str:
    """Return the ratios of the rates of the controllers to the rate of ``crazyflow``."""
    lines = [x for x in lines if "steps_per_s" in x]
    base = {x["machine"]: x["steps_per_s"] for x in lines if x["controller"] == "crazyflow"}
    return pivot(
        lines,
        machine_of,
        lambda x: f'`"{x["controller"]}"`',
        lambda x: f"{x['steps_per_s'] / base[x['machine']]:.2f} ({si_text(x['steps_per_s'])})",
        "Machine",
    )


def trainers(lines: list[Line]) -> str:
    """Return the table of ``trainers.py``."""
    names = {"crazysim": "crazysim", "brax": "Brax", "rsl_rl": "RSL-RL"}
    return columns(
        Worlds=worlds_text,
        Trainer=lambda x: f"{names[x['trainer']]} {x['version']}" + (f", torch {x['torch']}" if "torch" in x else ""),
        Environment_steps_a_second=lambda x: si_text(x["env_steps_per_s"]),
        Training_without_compilation=lambda x: f"{si_text(x['env_steps'])} steps in {duration_text(x['seconds'])}",
        Success_of_each_seed=lambda x: ", ".join(f"{success:.1%}" for success in x["success"]),
    )(lines)


def figure_text(line: Line) -> str:
    """Return a figure of ``validation.py`` with its unit."""
    return f"{line['figure']:.3g} {line.get('unit', '')}".strip()


def validation(lines: list[Line]) -> str:
    """Return a section of ``validation.py``, without empty columns."""
    cells = {
        "Quantity": [line["quantity"] for line in lines],
        "Reference": [line["reference"] for line in lines],
        "Figure": [figure_text(line) for line in lines],
        "Passes": [line.get("passes", "") for line in lines],
        "For comparison": [line.get("remark", "") for line in lines],
    }
    cells = {name: column for name, column in cells.items() if any(column)}
    return markdown_table(cells, zip(*cells.values(), strict=True))


def within(line: Line) -> float | None:
    """Return a figure over the end of its range, or its place in it; at most 1 is within, None has no range."""
    text = line.get("passes", "")
    if text.startswith("at most "):
        return line["figure"] / float(text.removeprefix("at most "))
    if not text:
        return None
    low, high = map(float, text.split(" to "))
    return abs(2 * line["figure"] - low - high) / (high - low)


def summary(lines: list[Line]) -> str:
    """Return for each section of ``validation.py`` the figures within their range, and the one closest to its end."""
    rows = []
    for name in dict.fromkeys(line["name"] for line in lines):
        ranged = [(share, x) for x in lines if x["name"] == name and (share := within(x)) is not None]
        if ranged:
            _, last = max(ranged, key=lambda pair: pair[0])
            count = f"{sum(share <= 1 for share, _ in ranged)} of {len(ranged)}"
            rows.append([f"`{name}`", count, last["quantity"], last["reference"], figure_text(last), last["passes"]])
    return markdown_table(["Section", "Within", "Closest to its range", "Reference", "Figure", "Passes"], rows)


def unranged(lines: list[Line]) -> str:
    """Return the figures without a range."""
    return validation([line for line in lines if within(line) is None])


def firmware(lines: list[Line]) -> str:
    """Return the differences from the firmware, with a column for real numbers and for integers."""

    def names(line: Line) -> tuple[str, str]:
        case, _, output = line["quantity"].rpartition(": ")
        if output != "motors":
            return case, output
        case, _, numbers = case.rpartition(", ")
        return case, f"{output}, {numbers}"

    return pivot(lines, lambda x: names(x)[0], lambda x: names(x)[1], figure_text, "Quantity")


def predictions(lines: list[Line]) -> str:
    """Return the errors of predictions by their time."""
    return pivot(
        lines,
        lambda x: x["quantity"].rpartition(", after ")[0],
        lambda x: x["quantity"].rpartition(", after ")[2],
        figure_text,
        "Quantity",
    )


def policies_for_any_airframe(lines: list[Line]) -> str:
    """Return shares of drones held with each delay, and errors of figure eights, by policy and time between calls."""
    cells: dict[tuple[str, str], list[Line]] = {}
    for line in lines:
        manoeuvre, airframes, period, _ = line["quantity"].split("; ")
        cells.setdefault((f"{manoeuvre}: {airframes}", f"{line['reference']}, {period}"), []).append(line)
    return pivot(
        [{"row": row, "column": column, "cell": cell} for (row, column), cell in cells.items()],
        lambda x: x["row"],
        lambda x: x["column"],
        lambda x: ", ".join(format(line["figure"], ".3g") for line in x["cell"]) + " " + x["cell"][0]["unit"],
        "Flights",
    )


def flights_by_sight(lines: list[Line]) -> str:
    """Return shares of forests crossed by policy, physics, images and noise, at each rate and latency."""
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for line in lines:
        images, rate, late, noise = line["quantity"].split(", ", 3)
        policy, simulator = line["reference"].split(", ")
        row = f"`{policy}`; {simulator}; {images.removeprefix('images of ')}; {noise.removeprefix('noise: ')}"
        cells.setdefault((row, rate), {})[late.removesuffix(" late")] = f"{line['figure']:.3g}"

    def cell_text(shares: dict[str, str]) -> str:
        return (
            ", ".join(shares.values()) + " %"
            if len(shares) == 4
            else ", ".join(f"{share} % ({late})" for late, share in shares.items())
        )

    return pivot(
        [{"row": row, "column": rate, "cell": shares} for (row, rate), shares in cells.items()],
        lambda x: x["row"],
        lambda x: x["column"],
        lambda x: cell_text(x["cell"]),
        "Policy; physics; images; noise",
    )


def transfers(lines: list[Line]) -> str:
    """Return the success of policies by simulator."""
    return pivot(
        lines,
        lambda x: x["quantity"].rpartition(": ")[0],
        lambda x: "C header and ONNX file, difference" if x["reference"] == "ONNX file" else x["reference"],
        figure_text,
        "Policy",
    )


def training(lines: list[Line]) -> str:
    """Return the table of ``train.py``."""
    names = {"ppo": "PPO", "apg": "analytic gradients", "dagger": "teacher by PPO, student by DAgger"}

    def seeds_text(line: Line) -> str:
        seeds = line["seeds"]
        is_range = seeds == list(range(seeds[0], seeds[-1] + 1)) and len(seeds) > 2
        diverged = f"; diverged: {', '.join(map(str, line['diverged']))}" if "diverged" in line else ""
        return (f"{seeds[0]} to {seeds[-1]}" if is_range else ", ".join(map(str, seeds))) + diverged

    def time_text(line: Line) -> str:
        text = f"{round_digits(line['seconds'], 2):g} s"
        text += f" for {line['together']} seeds" if line.get("together", 1) != 1 else ""
        return text + (f", {line['parallel']} at a time" if line["parallel"] != 1 else "")

    return columns(
        Task=lambda x: f"`{x['task']}`",
        Algorithm_and_environment_steps=lambda x: (
            f"{names[x['algorithm']]}, {round_digits(x['env_steps'] / 1e6, 2):g} M"
        ),
        Seeds=seeds_text,
        Least=lambda x: f"{x['least']:.1%}",
        Median=lambda x: f"{x['median']:.1%}",
        Mean_error=lambda x: "" if x["error"] is None else f"{round_digits(x['error'], 2):g} {x['unit']}",
        Time=time_text,
    )(lines)


def readme(lines: list[Line]) -> str:
    """Return the table of README.md."""
    machines = {"cpu": "Xeon", "gpu": "H100"}
    head = ["", "two cores of an Intel Xeon (AVX2)", "one NVIDIA H100"]

    def lines_of(name: str, device: str, **case: Any) -> list[Line]:
        case |= {"name": name, "machine": machines[device]}
        return [line for line in lines if all(line.get(key) == value for key, value in case.items())]

    def range_text(values: Iterable[float]) -> str:
        ordered_values = sorted(round_digits(value, 2) for value in values)
        return f"{ordered_values[0]:g} to {ordered_values[-1]:g}" if ordered_values else ""

    def join_texts(values: Iterable[str]) -> str:
        return " and ".join(values)

    auto, crazyflow_control = (
        {"control": "attitude", "controller": "auto"},
        {"control": "attitude", "controller": "crazyflow"},
    )
    euler = {"integrator": "euler"}
    largest_n_worlds = {"cpu": 16384, "gpu": 1048576}
    largest_case = {"cpu": ("versus", "crazysim_steps_per_s", 16384), "gpu": ("step", "steps_per_s", 4194304)}

    def steps(device: str, case: Line) -> str:
        name, key, n_worlds = largest_case[device]
        return join_texts(si_text(x[key]) for x in lines_of(name, device, n_worlds=n_worlds, **case, **euler))

    def gym(device: str) -> str:
        return join_texts(
            si_text(x["n_worlds"] * x["n_steps"] / x["crazysim_s"])
            for x in lines_of("queries", device, benchmark="versus_crazyflow/gym")
        )

    rows = {
        "physics steps per second, attitude commands": lambda device: steps(device, auto),
        "environment steps per second in compiled rollouts": lambda device: join_texts(
            si_text(x["env_steps_per_s"])
            for x in lines_of("envs", device, actions="random", n_worlds=largest_n_worlds[device])
        ),
        "environment steps per second through Gymnasium, 4,096 worlds": gym,
        "an iteration of a script with 1,024 worlds: attitude command, 5 steps, read": lambda device: join_texts(
            duration_text(x.get("crazysim_call_s") or x["iteration_s"])
            for x in lines_of("loop", device, n_worlds=1024, control="attitude")
            if x.get("controller", "auto") == "auto"
        ),
        "physics steps per second over Crazyflow 0.4.0's, with its controller in both": lambda device: range_text(
            x["ratio"] for x in lines_of("versus", device, **crazyflow_control, **euler)
        ),
        "gradients of 100 steps over Crazyflow 0.4.0's, with its controller in both": lambda device: range_text(
            x["ratio"] for x in lines_of("gradient-versus", device, **crazyflow_control)
        ).partition(" to ")[0],
    }
    return markdown_table(head, [[name, cells("cpu"), cells("gpu")] for name, cells in rows.items()])


def devices(lines: list[Line]) -> str:
    """Return rates by number of devices, and their ratios to the rate of one device.

    Exchanged bytes, memory and compile time are for the largest number of devices of one process. Rates of several
    processes, such as one on each host, are in the last columns of rates. Cases are measured in any order, and listed
    by name.
    """
    cases: dict[str, dict[tuple[int, int], Line]] = {}
    for line in lines:
        if "rate" in line:
            cases.setdefault(line["case"], {})[line["n_hosts"], line["n_devices"]] = line
    columns = sorted({column for case in cases.values() for column in case})
    names = [f"{n} device{'s' * (n > 1)}" + f" of {n_hosts} processes" * (n_hosts > 1) for n_hosts, n in columns]
    rows = []
    for name, case in sorted(cases.items(), key=lambda item: item[0].casefold()):
        last = case[max(column for column in case if column[0] == 1)]
        rates = [si_text(case[column]["rate"]) if column in case else "" for column in columns]
        sizes = sum(last["exchanged"].values()), last["memory_bytes"]
        exchanged, memory = (f"{x} B" if x < 1000 else f"{si_text(x)}B" for x in sizes)
        worlds = f"{worlds_text(last)} a {'seed' if name.startswith('seeds') else 'device'}"
        ratios = [f"{line['ratio']:.3g}" for (n_hosts, n), line in sorted(case.items()) if n_hosts == 1 and n > 1]
        facts = [", ".join(ratios), exchanged, memory, duration_text(last["compile_s"])]
        rows.append([f"{name}, {last['unit']} a second", worlds, *rates, *facts])
    return markdown_table(["", "Worlds", *names, "Ratios", "Bytes", "Memory", "Compile time"], rows)


SECTIONS = ("closed", "mujoco", "firmware", "crazyflow", "rotorpy", "commonroad", "idsia", "nanobench", "filter", "any")
TABLES: dict[str, tuple[tuple[str, ...], Callable[[list[Line]], str]]] = {
    "readme": (("loop", "step", "versus", "gradient-versus", "queries", "envs"), readme),
    "loop": (("loop",), loops),
    "step": (("step", "step-randomised", "limits"), rates),
    "versus": (("versus", "gradient-versus", "queries", "memory"), versus),
    "gradient": (("gradient",), gradients),
    "envs": (("envs", "envs-training", "envs-depth", "randomize"), env_rates),
    "depth": (("depth", "range-finder"), depths),
    "colors": (("colors",), colors),
    "maps": (("maps",), maps),
    "costs": (("plugins", "loads", "follow"), ratios),
    "plugins": (("plugins",), costs),
    "loads": (("loads",), costs),
    "follow": (("follow",), costs),
    "controllers-rates": (("controllers-rates",), control_rates),
    "further": (("coupled", "sight", "vehicles", "fleets", "mppi", "live", "mocap", "first-results"), further),
    "devices": (("devices",), devices),
    "training": (("training",), training),
    "trainers": (("trainers",), trainers),
    "controllers": (("controllers",), control),
    "racing": (("racing",), racing),
    "racing-battery": (("racing",), sagging),
    "validation": (tuple(f"validation-{name}" for name in (*SECTIONS, "sim2sim")), summary),
    "other-models": (("validation-rotorpy", "validation-commonroad"), unranged),
    "path-errors": (("path-errors",), path_errors),
    "validation-idsia": (("validation-idsia",), predictions),
    "validation-sim2sim": (("validation-sim2sim",), transfers),
    **{f"validation-{name}": ((f"validation-{name}",), validation) for name in SECTIONS if name != "idsia"},
    "validation-firmware": (("validation-firmware",), firmware),
    "validation-sight": (("validation-sight",), flights_by_sight),
    "validation-any": (("validation-any",), policies_for_any_airframe),
}
"""Figures of each table, and the function that makes it of their lines.

Any other table is one of ``docs/results/tables.json``.
"""


def figures_of(name: str) -> tuple[str, ...]:
    return TABLES[name][0] if name in TABLES else (name,)
