"""``crazysim live``: drones that circle, or fly a policy, and can be watched, piloted, commanded and recorded."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazysim.commands.options import (
    MAX_DRONES,
    SIMULATION_OPTIONS,
    DefaultsFormatter,
    add_page_options,
    add_simulation_options,
    has_screen,
    load_policy_and_env,
    number,
    require_screen,
    size,
    specified_options,
)
from crazysim.errors import ConfigError, require

if TYPE_CHECKING:
    from crazysim.lab.live.policy_pilot import PolicyPilot


def add_parsers(commands: argparse._SubParsersAction) -> None:
    text = "fly in real time: watch, pilot, command and record; print the real-time factor"
    parser = commands.add_parser("live", help=text, formatter_class=DefaultsFormatter)
    parser.set_defaults(run=run)
    add = parser.add_argument
    policy_help = "folder of a training run; its policy flies to goals that you type (x y z, m) or click"
    add("--policy", type=Path, metavar="FOLDER", help=policy_help)
    goals_help = "goals of the policy, one after another: x,y,z in each line, m"
    add("--goals", type=Path, metavar="FILE", help=goals_help)
    add("--drones", type=number(high=MAX_DRONES), metavar="N", help="drones in each world; by default 4")
    add("--worlds", type=number(), default=1, metavar="N", help="number of worlds")
    add("--seconds", type=size(20), help="simulated time, s; by default until all viewers are closed")
    read_speed = size("1, or max")
    add(
        "--speed",
        type=lambda text: text if text == "max" else read_speed(text),
        default="1",
        help="simulated seconds per second, or max for as fast as possible",
    )
    add("--window", action="store_true", help="show a window; by default where there is a screen")
    add("--browser", action="store_true", help="show a page in a browser; by default where there is no screen")
    add("--headless", action="store_true", help="show nothing; requires --seconds")
    add_page_options(parser)
    add("--fps", type=size(50), default=50.0, help="pictures per second, sent to viewers")
    add("--control-freq", type=number(example=100), metavar="HZ", help="rate of control steps, Hz; by default 100")
    add("--freq", type=number(example=500), metavar="HZ", help="rate of physics steps, Hz; by default 500")
    add("--record", type=Path, metavar="FILE", help="file to record to, for crazysim replay")
    add("--pilot", action="store_true", help="pilot the first drone with arrow keys, W, S, A, D and clicks")
    add("--gamepad", action="store_true", help="pilot the first drone with a gamepad and the keyboard")
    add("--commands", action="store_true", help="listen for commands over TCP, at ports 7000 and 7002")
    add_simulation_options(parser)


def run(options: argparse.Namespace) -> None:
    """Fly drones live, and print the figures."""
    from crazysim.envs.tasks.race import Race
    from crazysim.lab.live import Browser, CommandServer, Fleet, Gamepad, Live, Pilot, RemoteCommands, Window
    from crazysim.lab.live.circles import Circles
    from crazysim.lab.live.piloting import Sticks, keyboard_sticks
    from crazysim.lab.live.policy_pilot import typed_lines
    from crazysim.lab.racing.live_clock import LiveClock
    from crazysim.sim.sim import Sim

    # Viewers, and who commands the drones.
    viewers = [name for name in ("window", "browser") if getattr(options, name)]
    if options.headless and viewers:
        raise ConfigError(f"expected --headless or --{viewers[0]}, got both. Leave one out.")
    require(
        not options.headless or options.seconds is not None,
        "expected --seconds with --headless, got none. Use --seconds 20, for example.",
    )
    if not options.headless and not viewers:
        viewers = ["window" if has_screen() else "browser"]
    if options.window:
        require_screen("--browser or --headless")
    speed, is_piloted = options.speed, options.pilot or options.gamepad
    require(
        not options.commands or not is_piloted,
        "expected commands over TCP or a pilot, got both. Leave out --commands, or --pilot and --gamepad.",
    )
    # Simulation of a policy's task, or with state commands.
    policy_pilot, n_worlds = _policy_pilot(options), options.worlds
    if policy_pilot is None:
        control_freq = 100 if options.control_freq is None else options.control_freq
        n_drones = 4 if options.drones is None else options.drones
        settings: dict[str, Any] = {"freq": 500} | specified_options(options, "freq", *SIMULATION_OPTIONS)
        sim = Sim(n_worlds, n_drones, control="state", state_freq=control_freq, **settings)
    else:
        sim, control_freq = policy_pilot.env.sim, policy_pilot.env.base.freq
    with contextlib.ExitStack() as stack:
        live = stack.enter_context(Live(sim, control_freq, speed, options.fps))
        # Commands of a policy, a client or the demonstration.
        if policy_pilot is not None:
            policy_pilot.add_to(live)
            if isinstance(policy_pilot.env.task, Race):
                LiveClock(policy_pilot.env.task).add_to(live)
            policy_pilot.listen(live, typed_lines())
            print(f"type a goal as x y z, m{policy_pilot.arena and ': '}{policy_pilot.arena}", flush=True)
        elif options.commands:
            fleet = Fleet(sim, teleport=False)
            live.add(RemoteCommands(fleet, stack.enter_context(CommandServer())), name="commands")
        else:
            live.add(Circles(live, is_piloted), name="circles")
        # A pilot moves the setpoint of one drone.
        if is_piloted:
            sticks: list[Sticks] = [keyboard_sticks, *([Gamepad()] if options.gamepad else [])]
            pilot = Pilot(sticks)
            live.add(pilot, name="pilot")
            live.on_click = pilot.go_to
        # Viewers and recording.
        for viewer in viewers:
            if viewer == "browser":
                browser = live.show(Browser(options.port, options.host, contacts=n_worlds == 1))
                print(f"open {browser.url}; stop with Ctrl-C", flush=True)
            else:
                live.show(Window(worlds=tuple(range(min(n_worlds, 9)))))
        if options.record is not None:
            print(f"recording to {live.record(options.record)}", flush=True)
        print(live.run(options.seconds))
        if options.goals is not None and policy_pilot is not None:
            print(f"points passed: {', '.join(str(n) for n in policy_pilot.n_passed.ravel())}")


def _policy_pilot(options: argparse.Namespace) -> PolicyPilot | None:
    excluded = ("drones", "control_freq", "freq", "drone", "dynamics", "controller", "pilot", "gamepad", "commands")
    if options.policy is None:
        require(options.goals is None, "expected --policy with --goals, got none. Use --policy out/hover, for example.")
        return None
    if names := [f"--{name.replace('_', '-')}" for name in excluded if getattr(options, name) not in (None, False)]:
        raise ConfigError(f"expected the settings of the run with --policy, got {', '.join(names)}. Leave them out.")
    from crazysim.lab.live.policy_pilot import PolicyPilot, read_points

    points = None if options.goals is None else read_points(options.goals)
    policy, _, env = load_policy_and_env(options.policy, options.device, options.worlds)
    return PolicyPilot(env, policy, points)
