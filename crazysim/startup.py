"""The import of crazysim: environment variables, JAX and MuJoCo.

JAX and MuJoCo read environment variables when they are imported, so these variables are set first.

XLA logs an error of 3,000 characters for each CPU program that it loads from a persistent cache, because the options
``prefer-no-gather`` and ``prefer-no-scatter``, with which it compiled the program, are not features of any CPU.
Therefore XLA's errors are hidden. Real failures are raised as exceptions.

MuJoCo draws through GLFW by default, which needs a screen. Without a screen, EGL is selected if it is installed. A
value of ``MUJOCO_GL`` that MuJoCo refuses would make the import of crazysim fail. Therefore MuJoCo is imported here,
and again without drawing if that fails.

If JAX or MuJoCo is broken, the command ``crazysim``, including ``crazysim info``, ends with one line that says so.
"""

import ctypes
import importlib
import os
import sys
import warnings

__version__ = "0.2.0"
"""The version of the package; ``pyproject.toml`` says the same."""

refused_variables: dict[str, str] = {}
"""Values of environment variables that could not be used, by variable."""


def set_variables() -> None:
    """Set the variables that the user has not set."""
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":  # JAX sets 1, which a process passes to its children
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
    has_display = any(os.environ.get(name) for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"))
    if sys.platform == "linux" and not has_display and _has_egl():
        os.environ["MUJOCO_GL"] = "egl"


def import_mujoco() -> None:
    """Import MuJoCo, and warn if that only works with ``MUJOCO_GL=disable``."""
    try:
        import mujoco
    except Exception as error:  # OpenGL's libraries raise errors of many types
        backend = os.environ.get("MUJOCO_GL", "")
        os.environ["MUJOCO_GL"] = "disable"
        import mujoco  # noqa: F401

        refused_variables["MUJOCO_GL"] = backend
        warnings.warn(
            f"expected a MUJOCO_GL that MuJoCo can use, got {backend!r}: {error}. Use egl or glfw; "
            "until then nothing is drawn.",
            stacklevel=2,
        )


def _has_egl() -> bool:
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True


def _is_command() -> bool:
    name = os.path.basename(sys.argv[0] if sys.argv else "")
    return name in ("crazysim", "crazysim.exe") or (name == "-m" and "crazysim" in sys.orig_argv)


def import_required_packages() -> None:
    """Import JAX and MuJoCo.

    Raises:
        ImportError: If one of them is broken or missing, with its name.
        SystemExit: Instead, in the command ``crazysim``, which prints the message.
    """
    for name, import_package in (("jax", lambda: importlib.import_module("jax")), ("mujoco", import_mujoco)):
        try:
            import_package()
        except Warning:  # an error only where the user wants it, and its text says enough
            raise
        except Exception as error:  # a damaged package can raise any error
            reason = str(error).strip().partition("\n")[0][:300]
            text = (
                f"expected the package {name!r} to be importable, got {type(error).__name__}: {reason}. Install it "
                f"again: pip install --force-reinstall {name}"
            )
            if _is_command():
                print(f"crazysim: {text}", file=sys.stderr)
                sys.exit(2)
            raise ImportError(text, name=name) from error


set_variables()
import_required_packages()
