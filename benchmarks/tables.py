"""Markdown tables of the JSON lines of benchmarks, as ``figures.py`` writes them into the pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from measure import round_digits

Line = dict[str, Any]
"""JSON line of a benchmark, or dict of a figure: its name, its machine, its lines, ..."""


def pivot(
    lines: list[Line], row: Callable[..., str], column: Callable[..., str], value: Callable[..., str], corner: str
) -> str:
    """Return a Markdown table with a cell for each line.

    Args:
        lines: The lines.
        row: Function from a line to the name of its row.
        column: Function from a line to the name of its column.
        value: Function from a line to the text of its cell.
        corner: Heading of the names of rows.
    """
    cells = {(row(line), column(line)): value(line) for line in lines}
    columns = list(dict.fromkeys(name for _, name in cells))
    rows = dict.fromkeys(name for name, _ in cells)
    return markdown_table([corner, *columns], [[name, *(cells.get((name, x), "") for x in columns)] for name in rows])


def markdown_table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
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
    """Return the number of worlds as text."""
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


def loops(lines: list[Line]) -> str:
    """Return times of an iteration, followed by the ratio of Crazyflow's time to ours if it was measured."""

    def time_of(line: Line) -> str:
        if "ratio" in line:
            return f"{duration_text(line['crazysim_call_s'])}, {round_digits(line['ratio'], 2):g}"
        return duration_text(line["iteration_s"])

    names = {"loop/jax": "one compiled addition, with its result in NumPy", "loop/mj_step": "C MuJoCo, one box"}

    def row_of(line: Line) -> str:
        return names[line["benchmark"]] if line["benchmark"] in names else case_text(line).replace(", Euler", "")

    return pivot(lines, row_of, worlds_text, time_of, "Commands, worlds")


def versus(lines: list[Line]) -> str:
    """Return rates of crazysim and Crazyflow, their ratio, and the times of compilation."""
    return columns(
        Commands=case_text,
        Worlds=worlds_text,
        crazysim=lambda x: si_text(x["crazysim_steps_per_s"]),
        Crazyflow=lambda x: si_text(x["crazyflow_steps_per_s"]),
        Ratio=lambda x: f"{round_digits(x['ratio'], 2):g}",
        Compilation=lambda x: f"{x['crazysim_compile_s']:.2g} s, Crazyflow {x['crazyflow_compile_s']:.2g} s",
    )(lines)


def rates(lines: list[Line]) -> str:
    """Return steps per second by case and number of worlds."""
    return pivot(lines, case_text, worlds_text, lambda x: si_text(x["steps_per_s"]), "Commands, worlds")


def gradients(lines: list[Line]) -> str:
    """Return rates of gradients, and the ratios of their times to the times of the steps alone."""
    return columns(
        Commands=lambda x: LEVELS[x["control"]],
        Worlds=worlds_text,
        Steps_per_second=lambda x: si_text(x["n_worlds"] * x["n_steps"] / x["gradient_s"]),
        Over_steps_alone=lambda x: f"{x['forward_passes']:.2g}",
        Forward_mode_over_steps_alone=lambda x: f"{x['jvp_passes']:.2g}",
        First_gradient_compiles_in=lambda x: f"{x['compile_s']:.2g} s",
    )(lines)


def env_rates(lines: list[Line]) -> str:
    """Return environment steps per second by task and actions, and number of worlds."""
    names = {"random": "random actions", "policy": "a 64 x 64 policy", "bfloat16": "the same in bfloat16",
             "training": "iterations of PPO"}  # fmt: skip

    def row_of(line: Line) -> str:
        image = f", a depth image of {line['depth'][0]} x {line['depth'][1]}" if line["depth"] else ""
        randomized = ", `Randomize.crazyflie()`" if line["drones"] == "randomized" else ""
        return f"`{line['task']}`, {names[line['actions']]}{image}{randomized}"

    return pivot(lines, row_of, worlds_text, lambda x: si_text(x["env_steps_per_s"]), "Environment steps/s, worlds")


def queries(lines: list[Line]) -> str:
    """Return times of queries, environments and constructions of both programs."""
    names = {
        "contacts": "contacts after a step, 4,096 worlds of 4 drones, 8 objects",
        "depth": "64 x 64 depth of 1,024 worlds, 8 objects",
        "swarm_build": "`Sim(n_drones=1024)`",
        "gym": "100 steps of the Gymnasium environment, 4,096 worlds",
    }

    def row_of(line: Line) -> list[str]:
        name = line["benchmark"].partition("/")[2]
        if name == "memory":
            key, label = "bytes_per_world", f"memory of a world, drones: {line['n_drones']}"
            ours, theirs = (f"{round_digits(line[f'{x}_{key}'] / 1000):g} kB" for x in ("crazysim", "crazyflow"))
            return [label, ours, theirs, f"{round_digits(1 / line['ratio'], 2):g}"]
        return [
            names[name],
            duration_text(line["crazysim_s"]),
            duration_text(line["crazyflow_s"]),
            f"{round_digits(line['ratio'], 2):g}",
        ]

    return markdown_table(["", "crazysim", "Crazyflow", "Crazyflow over crazysim"], [row_of(line) for line in lines])


def poles_text(line: Line) -> str:
    """Return the poles of a scene as text."""
    return f"{line['n_poles']:,} {'movable' if line['movable'] else 'fixed'} poles" if line["n_poles"] else "none"


depths = columns(
    Poles=poles_text,
    Image=lambda x: f"{x['width']} x {x['height']}, {x['n_worlds']:,} worlds",
    Rays_per_second=lambda x: si_text(x["rays_per_s"]),
    First_image=lambda x: duration_text(x["first_s"]),
)
"""Table of ``depth.py``."""
sight = columns(
    Case=lambda x: {
        "policy": "`forest` with its convolution, environment steps a second",
        "lidar": "a lidar at 10 Hz, real-time factor of each world",
    }[x["case"]],
    Image=lambda x: f"{x['image'][0]} x {x['image'][1]}, {x['n_worlds']:,} worlds",
    Rate=lambda x: si_text(x["env_steps_per_s"] if x["case"] == "policy" else x["realtime"]),
    Rays_per_second=lambda x: si_text(x["rays_per_s"]),
    First_call=lambda x: duration_text(x["first_s"]),
)
"""Table of ``sight.py``."""
range_finders = columns(
    Poles=poles_text,
    Worlds=worlds_text,
    One_step=lambda x: duration_text(1e-6 * x["step_us"]),
    First_step=lambda x: duration_text(x["first_s"]),
)
"""Table of ``depth.py --range-finder``."""


def costs(lines: list[Line]) -> str:
    """Return the times of cases divided by the times of their references, and the rates of the cases."""
    return columns(
        Case=lambda x: f"`{x['case']}`",
        Time_over_reference=lambda x: f"{x['ratio']:.3g}",
        Reference=lambda x: f"`{x['reference']}`",
        Steps_per_second=lambda x: si_text(x["steps_per_s"]),
        First_call=lambda x: duration_text(x["first_s"]),
    )(lines)


coupled = columns(
    Drones_per_world=lambda x: str(x["n_drones"]),
    with_downwash=lambda x: si_text(x["steps_per_s"]["downwash"]),
    without=lambda x: si_text(x["steps_per_s"]["uncoupled"]),
)
"""Table of ``coupled.py``."""
fleets = columns(
    Fleet=lambda x: {
        "cars": "four drones and two cars, over the drones alone",
        "airframes": "two airframes, over one with parameters per drone",
    }[x["case"]],
    Worlds=worlds_text,
    Rate_of_the_drones=lambda x: f"{round_digits(x['ratio'], 2):g}",
)
"""Table of ``fleets.py``."""
vehicles = columns(Case=lambda x: f"`{x['case']}`", Steps_per_second=lambda x: si_text(x["steps_per_s"]))
"""Table of ``vehicles.py``."""
path_errors = columns(
    Controller=lambda x: f"`{x['controller']}`",
    **{
        f"`{vehicle}`": lambda x, v=vehicle: f"{', '.join(f'{100 * e:.1f}' for e in x['errors'][v])} cm"
        for vehicle in ("f1tenth_ros", "aiml_head")
    },
)
"""Largest errors of each controller with two models of cars, one for each speed of ``vehicles.py --errors``."""
commands = columns(
    Samples=lambda x: f"{x['samples']:,}",
    Commands_per_second=lambda x: si_text(x["commands_per_s"]),
    Compilation=lambda x: duration_text(x["compile_s"]),
)
"""Table of ``mppi.py``: commands that sampling MPC computes per second, by number of sampled rollouts."""
live = columns(
    Case=lambda x: f"`{x['case']}`, {x['n_drones']} drones",
    Times_real_time=lambda x: f"{x['factor']:g}",
    Late_by_at_most_in_999_of_1000_steps=lambda x: f"{x['lateness_999_ms']:g} ms",
    worst=lambda x: f"{x['worst_ms']:g} ms",
)
"""Table of ``live.py``."""
mocap = columns(
    Objects=lambda x: f"{x['n_objects']} at {x['freq']:g} Hz",
    Rules_of_a_frame=lambda x: f"{x['frame_ms']:g} ms",
    Update_of_the_simulation=lambda x: f"{x['update_ms']:g} ms",
    Lost_frames=lambda x: str(x["lost"]),
)
"""Table of ``mocap.py``. The rules of a frame decide which measured poses are used."""


def first_results(lines: list[Line]) -> str:
    """Return times to the first results without and with programs in the cache."""
    names = {
        "step": "step",
        "gradient": "gradient of 100 steps, 64 worlds of 2 drones",
        "contacts": "step and `contacts()`, 64 worlds of 2 drones",
        "gymnasium": "Gymnasium: make, reset, step",
        "render": "`render`",
    }
    heads = {"off": "`CRAZYSIM_CACHE=off`", "on": "second run"}
    return pivot(
        lines,
        lambda x: names[x["case"]],
        lambda x: heads[x["cache"]],
        lambda x: f"{x['wall_s']:.1f} s",
        "First result",
    )


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
    return markdown_table(head, [row_of(line) for line in lines if "drone" in line])


def control_rates(lines: list[Line]) -> str:
    """Return the ratios of the rates of the controllers to the rate of ``crazyflow``."""
    rate_by_controller = {line["controller"]: line["steps_per_s"] for line in lines if "steps_per_s" in line}
    cells = [f"{rate / rate_by_controller['crazyflow']:.2f} ({si_text(rate)})" for rate in rate_by_controller.values()]
    return markdown_table([f'`"{name}"`' for name in rate_by_controller], [cells])


def limits(lines: list[Line]) -> str:
    """Return the measured rates as fractions of the highest possible rates."""
    lines = [line for line in lines if "ratio" in line]
    return pivot(lines, case_text, worlds_text, lambda x: f"{1 / x['ratio']:.0%}", "Commands, worlds")


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


def validation_by(separator: str) -> Callable[[list[Line]], str]:
    """Return a function that makes a table with a column for each end of the quantities, after a separator."""
    return lambda lines: pivot(
        lines,
        lambda x: x["quantity"].rpartition(separator)[0],
        lambda x: x["quantity"].rpartition(separator)[2],
        figure_text,
        "Quantity",
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


def readme(records: list[Line]) -> str:
    """Return the table of README.md: two cores without AVX-512, and one H100."""
    kinds = {"cpu": "AVX2", "gpu": "H100"}
    head = ["", "two cores of an Intel Xeon (AVX2)", "one NVIDIA H100"]

    def lines_of(name: str, device: str, **case: Any) -> list[Line]:
        lines = [
            line
            for record in records
            if record["figure"] == name and kinds[device] in record["machine"]
            for line in record["lines"]
        ]
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
    text = markdown_table(["", "Worlds", *names, "Ratios", "Bytes", "Memory", "Compile time"], rows)
    for line in lines:
        if "difference" in line:
            text += (
                f"\n\nThree iterations of PPO moved the weights by {line['moved']:.3g} (Euclidean norm); those on "
                f"{line['n_devices']} devices differ from those on {line['compared_with']} by {line['difference']:.2g}."
            )
    return text
