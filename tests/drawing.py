"""Images of tests: coarse shadows and edges, which take most of the time where no GPU draws."""

import mujoco


def draw_coarsely(monkeypatch):
    """Let renderers that are made from now on draw coarse shadows, and edges without smoothing."""

    class Coarse(mujoco.Renderer):
        def __init__(self, model, *settings, **more):
            model.vis.quality.shadowsize = 256
            model.vis.quality.offsamples = 0
            super().__init__(model, *settings, **more)

    monkeypatch.setattr(mujoco, "Renderer", Coarse)
