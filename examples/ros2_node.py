"""A ROS 2 node: poses of the tool in (PoseStamped on `tool_pose`), the soil's wrench out (WrenchStamped on
`soil_wrench`).

python examples/ros2_node.py  # with ROS 2 sourced; without it, the node's core is tried with messages of its own

Stamps are the time of the soil. Poses are those of the tool's centre of mass in the bed's frame.
"""

import importlib.util
from types import SimpleNamespace
from typing import Any

import numpy as np

import sgns
from mpm_warp import Scene
from sgns.coupling import Coupling


def read(message: Any) -> tuple[float, list[float]]:
    """Time [s] and pose of a PoseStamped."""
    stamp, place, turn = message.header.stamp, message.pose.position, message.pose.orientation
    return stamp.sec + 1e-9 * stamp.nanosec, [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]


class Answers:
    """The node without ROS: a PoseStamped comes, a WrenchStamped is filled."""

    def __init__(self, soil: Coupling) -> None:
        self.soil = soil

    def answer(self, message: Any, reply: Any) -> Any:
        """The reply, filled. A stamp that goes back, as of a bag played again, begins with a fresh bed."""
        time, pose = read(message)
        if time < self.soil.time:
            self.soil.reset(time=time)
        wrench = self.soil.step(time, pose)
        reply.header.stamp = message.header.stamp
        reply.header.frame_id = message.header.frame_id
        for part, values in ((reply.wrench.force, wrench.force), (reply.wrench.torque, wrench.torque)):
            part.x, part.y, part.z = map(float, values)
        return reply


def main() -> None:
    import rclpy
    from geometry_msgs.msg import PoseStamped, WrenchStamped
    from rclpy.node import Node

    rclpy.init()
    node, core = Node("soil"), Answers(Coupling(sgns.Simulator.pretrained("excavation")))
    publisher = node.create_publisher(WrenchStamped, "soil_wrench", 10)

    def heard(message: PoseStamped) -> None:
        try:
            publisher.publish(core.answer(message, WrenchStamped()))
        except sgns.UserError as error:
            node.get_logger().error(str(error))

    node.create_subscription(PoseStamped, "tool_pose", heard, 10)
    rclpy.spin(node)


def message(time: float = 0.0, pose: Any = (0, 0, 0, 0, 0, 0, 1)) -> SimpleNamespace:
    """What has the fields of both kinds of message."""
    vector = [SimpleNamespace(x=0.0, y=0.0, z=0.0) for _ in range(2)]
    stamp = SimpleNamespace(sec=int(time), nanosec=round(1e9 * (time - int(time))))
    place = SimpleNamespace(**dict(zip("xyz", pose[:3], strict=True)))
    turn = SimpleNamespace(**dict(zip("xyzw", pose[3:], strict=True)))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="bed"),
        pose=SimpleNamespace(position=place, orientation=turn),
        wrench=SimpleNamespace(force=vector[0], torque=vector[1]),
    )


def without_ros() -> None:
    """A cut by messages; its forces are those of the simulator."""
    simulator = sgns.Simulator.pretrained("excavation")
    core = Answers(Coupling(simulator))
    poses = Scene.from_dict(simulator.scene).body_poses()[:120]
    replies = [core.answer(message(i / 60, pose), message()) for i, pose in enumerate(poses)]
    forces = np.array([[one.wrench.force.x, one.wrench.force.y, one.wrench.force.z] for one in replies])
    print(f"no ROS here: {len(poses)} messages answered, the last with {forces[-1].round(1)} N")
    assert np.allclose(forces, simulator.rollout(poses).force, atol=0.1)


if __name__ == "__main__":
    main() if importlib.util.find_spec("rclpy") else without_ros()
