"""A walk through a scene, for listening and for trying out."""

import asyncio
import math

import numpy as np

from nafir_client.pose import Pose, Position
from nafir_client.recording import PathAsHeard
from nafir_client.scene import Scene
from nafir_client.stream import Stream

POSES_PER_S = 30


class Walk:
    """A walk along straight lines between waypoints, at constant speed, which takes `duration_s`."""

    def __init__(self, waypoints: list[Position], duration_s: float) -> None:
        self.duration_s = duration_s
        self._points = np.array(waypoints)
        self._steps = np.linalg.norm(np.diff(self._points, axis=0), axis=1)

    @classmethod
    def through(cls, scene: Scene, duration_s: float) -> "Walk":
        """From the scene's starting place through every opening, to a metre before the place of the emitter."""
        start, goal = scene.listener.position, np.array(scene.emitter.position)
        doors: list[Position] = [
            ((door.start[0] + door.end[0]) / 2, (door.start[1] + door.end[1]) / 2, start[2]) for door in scene.openings
        ]
        last = np.array(doors[-1] if doors else start)
        x, y, z = (goal + (last - goal) / max(1.0, float(np.linalg.norm(last - goal)))).tolist()
        return cls([start, *doors, (x, y, z)], duration_s)

    def pose_at(self, time_s: float) -> Pose:
        """The listener looks ahead, and up to 40 degrees to either side, once every four seconds."""
        walked = np.clip(time_s / self.duration_s, 0, 1) * self._steps.sum()
        ends = np.cumsum(self._steps)
        leg = min(int(np.searchsorted(ends, walked)), len(ends) - 1)
        here, there = self._points[leg], self._points[leg + 1]
        share = 1 - (ends[leg] - walked) / max(self._steps[leg], 1e-9)
        heading = math.atan2(there[1] - here[1], there[0] - here[0])
        glance = math.radians(40) * math.sin(2 * math.pi * time_s / 4)
        return Pose.of(here + share * (there - here), yaw=heading + glance)

    async def go(self, stream: Stream, path: PathAsHeard, time_s: float = 0.0) -> None:
        """Put the first listener where the walk is after so many seconds. `path` notes the pose."""
        pose = self.pose_at(time_s)
        path.note_pose(await stream.move_listener(pose.position, orientation=pose.orientation), pose)

    async def stroll(self, stream: Stream, path: PathAsHeard) -> None:
        """Take the first listener along the walk, from now to its end."""
        started_s = (loop := asyncio.get_running_loop()).time()
        for step in range(1, round(self.duration_s * POSES_PER_S) + 1):
            await asyncio.sleep(started_s + step / POSES_PER_S - loop.time())
            await self.go(stream, path, step / POSES_PER_S)
