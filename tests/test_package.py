"""The package as users install it: its requirements, exports, and the contents of the wheel."""

import ast
import collections
import importlib
import pkgutil
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from lower_bounds import UNBOUNDED_EXTRAS, lower_bounds

import crazysim
from crazysim.names import NAMES

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SOURCES = sorted((ROOT / "crazysim").rglob("*.py"))


def test_runtime_needs_exactly_five_packages():
    names = {requirement.split(">")[0].split("[")[0].strip() for requirement in PROJECT["dependencies"]}
    assert names == {"jax", "mujoco", "mujoco-mjx", "numpy", "gymnasium"}


def test_every_requirement_has_a_lower_bound():
    """``.ci/dist`` installs them."""
    bounds = lower_bounds(PROJECT["optional-dependencies"].keys() - UNBOUNDED_EXTRAS)
    assert not [name for name, bound in bounds.items() if bound is None]
    assert {"jax", "gymnasium", "optax", "viser"} <= bounds.keys()


def test_every_module_can_be_imported():
    """Unless a package of an extra is missing."""
    failed = {}
    for module in pkgutil.walk_packages(crazysim.__path__, "crazysim."):
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            is_missing = isinstance(error, ModuleNotFoundError) and not error.name.startswith("crazysim")
            if not is_missing and "which is not installed. Run pip install" not in str(error):
                failed[module.name] = str(error)
    assert not failed


def test_public_names_exist_once():
    assert len(crazysim.__all__) == len(set(crazysim.__all__))
    assert all(hasattr(crazysim, name) for name in crazysim.__all__)
    assert crazysim.__version__ == PROJECT["version"]


@pytest.mark.parametrize("module", ["crazysim", "crazysim.control", "crazysim.envs"])
def test_a_star_import_needs_no_optional_package(module, monkeypatch):
    for name in ("stable_baselines3", "crazysim.envs.pettingzoo", "crazysim.envs.rsl_rl", "crazysim.envs.sb3"):
        monkeypatch.setitem(sys.modules, name, None)
    names = {}
    exec(f"from {module} import *", names)
    assert names.keys() >= set(sys.modules[module].__all__)


def exported(module):
    return [name for names in NAMES[module].values() for name in names.split()]


def imported_for_types(module):
    """Yield the names that a package imports below ``if TYPE_CHECKING``."""
    for node in ast.parse(Path(importlib.import_module(module).__file__).read_text()).body:
        if isinstance(node, ast.If):
            yield from ((x.asname or x.name, child.module) for child in node.body for x in child.names)


@pytest.mark.parametrize("module", NAMES)
def test_names_of_the_table_exist(module):
    """Static checkers read another list, ``if TYPE_CHECKING``, which agrees. Some names need optional packages."""
    package = importlib.import_module(module)
    if module == "crazysim.train":
        pytest.importorskip("optax")
    assert all(getattr(package, name) is not None for name in exported(module) if name in package.__all__)
    assert not hasattr(package, "nothing")
    assert {*exported(module), *package.__all__} <= {*dir(package)}
    if package.__spec__.has_location:
        assert dict(imported_for_types(module)).keys() == set(exported(module))
    else:
        assert package.__all__ == exported(module)


@pytest.mark.parametrize(
    "path", ["sim.Sim", "sim.data.SimData", "sim.functional.state_control", "sim.pipeline.append_fn",
             "sim.sim.sync_sim2mjx", "sim.sim.use_box_collision", "sim.visualize.draw_line", "sim.sharding.world_mesh",
             "sim.integration.rk4", "sim.sensors.depth.render_depth", "sim.sensors.splat.viewmats",
             "sim.splat.attach_splats", "sim.dynamics.so_rpy_rotor_drag_dynamics",
             "control.Control", "control.parameters.load_params", "dynamics.Dynamics",
             "dynamics.parameters.load_fn_params", "dynamics.utils.data_utils.preprocessing",
             "dynamics.utils.identification.sys_id_rotation", "drones.Drone", "utils.leaf_replace",
             "utils.enable_cache", "utils.CORE_NDIM_KEY",
             "dynamics.supported_drones", "dynamics.supported_dynamics", "exception.CrazyflowError"],
)  # fmt: skip
def test_import_paths_of_crazyflow_exist(path):
    module, _, name = path.rpartition(".")
    assert hasattr(importlib.import_module(f"crazysim.{module}"), name)


def test_gravity_is_written_once():
    """As a number in the code. Texts of MJCF are not checked."""
    named = [source for source in SOURCES if "9.81" in source.read_text()]
    nodes = [(source, node) for source in named for node in ast.walk(ast.parse(source.read_text()))]
    places = [source.stem for source, node in nodes if isinstance(node, ast.Constant) and node.value == 9.81]
    assert places == ["airframe"]


def test_extras_are_never_imported_at_module_level():
    extras = {"matplotlib", "imageio_ffmpeg", "tqdm", "casadi", "viser", "trimesh", "onnx", "pettingzoo", "brax"}
    extras |= {"rsl_rl", "stable_baselines3", "tensordict", "torch", "splax"}
    for source in SOURCES:
        for node in ast.parse(source.read_text()).body:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not extras & {name.split(".")[0] for name in names}, source


def test_extras_that_messages_and_pages_name_exist():
    texts = [
        *SOURCES,
        *(ROOT / name for name in ("README.md", "CHANGELOG.md", "Makefile")),
        *(ROOT / "docs").rglob("*.md"),
    ]
    named = re.findall(r"""(?:crazysim|["']\.)\[([a-z0-9,]+)\]""", "\n".join(path.read_text() for path in texts))
    assert named
    assert {extra for extras in named for extra in extras.split(",")} <= PROJECT["optional-dependencies"].keys()


def exported_names(sources):
    trees = [ast.parse(source) for source in sources]
    lists = [x.value for tree in trees for x in tree.body if isinstance(x, ast.Assign) and "__all__" in ast.unparse(x)]
    return {ast.literal_eval(item) for value in lists if isinstance(value, ast.List) for item in value.elts}


def undocumented_names(sources, names):
    nodes = [node for source in sources for node in ast.parse(source).body if hasattr(node, "name")]
    methods, bases = collections.defaultdict(dict), collections.defaultdict(set)
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            for x in node.body:
                if isinstance(x, ast.FunctionDef):
                    methods[node.name][x.name] = bool(ast.get_docstring(x)) or methods[node.name].get(x.name, False)
            bases[node.name] |= {ast.unparse(base).split("[")[0].split(".")[-1] for base in node.bases}

    def is_documented(name, method, seen=()):
        return name not in seen and (
            methods[name].get(method, False) or any(is_documented(b, method, (*seen, name)) for b in bases[name])
        )

    public = [(name, method) for name in {*methods} & {*names} for method in list(methods[name]) if method[0] != "_"]
    return [node.name for node in nodes if node.name in names and not ast.get_docstring(node)] + [
        f"{name}.{method}" for name, method in public if not is_documented(name, method)
    ]


def test_exported_names_and_their_methods_are_documented_where_they_are_defined_or_in_a_base():
    """Ruff's D102 and D103 also complain about overrides and about functions that users do not see."""
    sources = [source.read_text() for source in SOURCES]
    names = exported_names(sources)
    assert {"Sim", "Wind", "load_airframe"} <= names
    assert not undocumented_names(sources, names)
    assert undocumented_names(["class A:\n    def f(self): ...\nclass B(A):\n    '1'"], ["A", "B"]) == ["A", "A.f"]
    assert not undocumented_names(["class A:\n    '1'\n    def f(self): '2'\nclass B(A):\n    '3'"], ["A", "B"])


def test_the_wheel_holds_scene_airframes_and_type_marker(tmp_path):
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path], cwd=ROOT, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for needed in ("crazysim/scene.xml", "crazysim/py.typed", *(f"crazysim/drones/{d}.toml" for d in crazysim.Drone)):
        assert needed in names
    assert not [name for name in names if name.startswith("tests")]


def yaml_of(path):
    return yaml.safe_load((ROOT / path).read_text())


@pytest.mark.parametrize("path", [".pre-commit-config.yaml", ".github/workflows/ci.yml", ".ci/run", "CONTRIBUTING.md"])
def test_every_target_of_make_that_is_named_exists(path):
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = set(re.findall(r"\bmake ([a-z-]+)", (ROOT / path).read_text()))
    assert named
    assert named <= targets


def commands_of_make(*arguments):
    make = ["make", "--dry-run", "--no-print-directory", *arguments]
    return subprocess.run(make, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()


@pytest.mark.parametrize(
    ("target", "extra"),
    [
        ("demo", "demo"),
        ("test", "test"),
        ("test-rest", "test"),
        ("test-all", "test"),
        ("check", "check"),
        ("docs", "docs"),
    ],
)
def test_a_target_installs_its_extra_once(target, extra, tmp_path):
    settings = f"VENV={tmp_path}", "PINS=jax<0.12 casadi"
    installed = [re.findall(r'"(.+?)"', line) for line in commands_of_make(target, *settings) if " install " in line]
    assert installed == [[f".[{extra}]", "jax<0.12", "casadi"]]
    (tmp_path / f"installed-{extra}").touch()
    lines = commands_of_make(target, *settings)
    assert lines
    assert not [line for line in lines if " install " in line]


def test_the_target_rest_runs_the_tests_that_make_test_leaves_out():
    chosen = commands_of_make("test")[-1].split('"not slow" ')[1].split()
    rest = commands_of_make("test-rest")[-1].split('"not slow" ')[1].split()
    assert rest == [f"--ignore={path}" for path in chosen]
    assert all((ROOT / path).exists() for path in chosen)
    assert commands_of_make("test", "TESTS=tests/control")[-1].endswith('"not slow" tests/control')


def test_workflows_and_templates_are_complete():
    jobs = yaml_of(".github/workflows/ci.yml")["jobs"]
    assert all(job["steps"] and job["timeout-minutes"] for job in jobs.values())
    assert [hook["entry"] for repo in yaml_of(".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]]
    for name in ("bug", "feature"):
        template = yaml_of(f".github/ISSUE_TEMPLATE/{name}.yml")
        assert template["name"]
        assert template["description"]
        assert "crazysim info" in str(template["body"])


def test_the_citation_is_of_this_version():
    citation = yaml_of("CITATION.cff")
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    assert citation["keywords"] == PROJECT["keywords"]
    assert citation["authors"] == PROJECT["authors"]
