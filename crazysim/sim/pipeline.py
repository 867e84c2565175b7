"""Functions that edit pipelines, under Crazyflow's import path."""

from crazysim.core.pipeline import (
    Pipeline,
    append_fn,
    insert_fn_after,
    insert_fn_before,
    prepend_fn,
    remove_fn,
    replace_fn,
)

__all__ = ["Pipeline", "append_fn", "insert_fn_after", "insert_fn_before", "prepend_fn", "remove_fn", "replace_fn"]
