"""What drones measure, where Crazyflow has it; ``sim.depth`` and ``sim.scene.depth_fn`` are its home."""
