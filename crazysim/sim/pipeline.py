"""Functions that edit pipelines, where Crazyflow has them."""

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
