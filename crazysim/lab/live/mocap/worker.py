"""Program that prints the frames of a motion capture system as lines of JSON; it imports nothing of crazysim.

    python worker.py SYSTEM HOSTNAME

It ends after the process that reads its output.
"""

import json
import sys
import time


def main() -> None:
    """Connect, and print every frame."""
    system, hostname = sys.argv[1:3]
    try:
        import motioncapture

        capture = motioncapture.connect(system, {"hostname": hostname})
    except Exception as error:
        print(json.dumps({"error": f"no connection to {system} at {hostname}: {error}"}), flush=True)
        return
    while True:
        capture.waitForNextFrame()
        now = time.monotonic()
        bodies = []
        for name, body in capture.rigidBodies.items():
            q = body.rotation
            bodies.append([name, *map(float, body.position), q.x, q.y, q.z, q.w])
        try:
            print(json.dumps({"t": now, "bodies": bodies}), flush=True)
        except BrokenPipeError:
            return


if __name__ == "__main__":
    main()
