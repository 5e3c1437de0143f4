"""How often the target is found unaided: random cluttered scenes, right, refused, or wrong.

    python benchmarks/corner_finding.py [--scenes 200] [--first 0]

Each scene draws its own instrument, its pose with any yaw, the target and its size, ground, walls or none, clutter, and
three to six places of one or two frames. An answer is right within 3 degrees and 100 mm, which no other corner of the
scene gives.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np

from lidarpose.errors import InputError, UndeterminedError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.corner_session import CornerSession
from lidarpose.simulate.corner_scene import CornerSceneSpec, CornerTruth, paper_rotation, simulate_corner_session
from lidarpose.workflows.corner_target import check_layout
from lidarpose.workflows.world import calibrate_world


def random_scene(seed: int) -> tuple[CornerSceneSpec, CornerSession, CornerTruth]:
    """A scene drawn from a seed, one in which the instrument sees whole targets at places off one line."""
    rng = np.random.default_rng([seed, 2026])
    while True:
        angles = rng.uniform(-180.0, 180.0), rng.uniform(5.0, 30.0), rng.uniform(-8.0, 8.0)
        position = np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(1.1, 1.7)])
        spec = CornerSceneSpec(
            pose=Pose(paper_rotation(*angles), position),
            target=rng.choice(["cube", "arrow", "oblique", "concave"]),
            lidar=str(rng.choice(["hdl32", "hdl32", "vlp16", "turntable"])),
            places=int(rng.integers(3, 7)),
            frames=int(rng.integers(1, 3)),
            seed=int(rng.integers(2**31)),
            size_m=float(rng.uniform(0.4, 0.6)),
            room=bool(rng.random() < 0.7),
            clutter=int(rng.integers(3, 13)),
        )
        try:
            session, truth = simulate_corner_session(spec)
            check_layout(session)
        except (ValueError, InputError, UndeterminedError):
            continue
        return spec, session, truth


def outcome(session: CornerSession, truth: CornerTruth) -> tuple[str, str]:
    """What came out, and in words."""
    try:
        result = calibrate_world(session)
    except UndeterminedError as error:
        return "refused", str(error).splitlines()[0]
    metres, radians = result.T_world_source.distance(truth.T_world_lidar)
    quality = result.quality
    assert quality is not None
    right = metres < 0.1 and np.degrees(radians) < 3.0
    text = f"{1e3 * metres:.2f} mm {np.degrees(radians):.3f} deg {'; '.join(quality.reasons)}"
    return f"{'right' if right else 'wrong'}, {quality.verdict}", text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    tally: Counter[str] = Counter()
    for seed in range(arguments.first, arguments.first + arguments.scenes):
        spec, session, truth = random_scene(seed)
        began = time.perf_counter()
        kind, text = outcome(session, truth)
        tally[kind] += 1
        seconds = time.perf_counter() - began
        scene = f"{spec.lidar} {spec.target} {spec.places}x{spec.frames} room={spec.room} clutter={spec.clutter}"
        print(f"{seed:4d} {scene}: {kind} ({seconds:.1f} s) {text}", flush=True)
    print(dict(tally), flush=True)


if __name__ == "__main__":
    main()
