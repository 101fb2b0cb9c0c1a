"""A ROS 2 node that decides: camera topics in, poses of the waypoints out.

    ros2 run tf2_ros static_transform_publisher ... workspace camera_color_optical_frame
    python examples/12_ros2_node.py --ros-args -p policy:=shipped

Topics: /camera/color/image_raw, /camera/aligned_depth_to_color/image_raw, and their camera_info.
Service ~/decide (std_srvs/Trigger) publishes a PoseArray on ~/waypoints, in the workspace's frame,
and answers with the decision as JSON. The conversions are tested; the node was not run under ROS.
"""

import json
import sys
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from csac_jax.deploy import CameraPolicy


def image(message: Any) -> np.ndarray:
    """Returns pixels of a sensor_msgs/Image: rgb8 and bgr8 as RGB, 16UC1 (mm) and 32FC1 as m."""
    kinds = {"rgb8": ("u1", 3), "bgr8": ("u1", 3), "16UC1": ("u2", 1), "32FC1": ("f4", 1)}
    if message.encoding not in kinds:
        raise ValueError(f"encoding {message.encoding} is not one of: {', '.join(kinds)}")
    kind, channels = kinds[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    used = np.ascontiguousarray(rows[:, : message.width * channels * dtype.itemsize]).view(dtype)
    if channels == 3:
        pixels = used.reshape(message.height, message.width, 3)
        return pixels[..., ::-1] if message.encoding == "bgr8" else pixels
    return used.astype(np.float32) * (np.float32(1e-3) if kind == "u2" else np.float32(1))


def intrinsics(info: Any) -> dict[str, Any]:
    """Returns the intrinsics that `CameraPolicy.decide` takes, of a sensor_msgs/CameraInfo."""
    names = {"fx": info.k[0], "fy": info.k[4], "cx": info.k[2], "cy": info.k[5]}
    return {"width": info.width, "height": info.height, **names, "distortion": tuple(info.d)[:5]}


def matrix(transform: Any) -> np.ndarray:
    """Converts a geometry_msgs/Transform to 4 x 4."""
    q, t, pose = transform.rotation, transform.translation, np.eye(4)
    pose[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    pose[:3, 3] = t.x, t.y, t.z
    return pose


def main(*arguments: str) -> None:
    """Runs the node until it is stopped."""
    import rclpy
    from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion
    from sensor_msgs.msg import CameraInfo, Image
    from std_srvs.srv import Trigger
    from tf2_ros import Buffer, TransformListener

    rclpy.init(args=list(arguments))
    node, newest = rclpy.create_node("csac_jax"), {}
    policy = CameraPolicy.load(node.declare_parameter("policy", "shipped").value)
    buffer = Buffer()
    TransformListener(buffer, node)
    for name, kind in (("color", Image), ("aligned_depth_to_color", Image)):
        node.create_subscription(
            kind, f"/camera/{name}/image_raw", lambda m, name=name: newest.update({name: m}), 1
        )
    node.create_subscription(
        CameraInfo, "/camera/color/camera_info", lambda m: newest.update(info=m), 1
    )
    publisher = node.create_publisher(PoseArray, "~/waypoints", 1)

    def decide(_: Any, answer: Any) -> Any:
        try:
            colour, depth = newest["color"], newest["aligned_depth_to_color"]
            found = buffer.lookup_transform("workspace", colour.header.frame_id, rclpy.time.Time())
            camera = intrinsics(newest["info"]), matrix(found.transform)
            (decision,) = policy.decide(image(colour), image(depth), *camera)
        except Exception as error:  # no image yet, no transform, nothing to act on
            answer.success, answer.message = False, repr(error)
            return answer
        poses = PoseArray()
        poses.header.frame_id = "workspace"
        for waypoint in decision.waypoints:
            turn = Rotation.from_matrix(np.array(waypoint.tool)[:3, :3]).as_quat()
            place, turned = Point(), Quaternion()
            place.x, place.y, place.z = waypoint.position
            turned.x, turned.y, turned.z, turned.w = map(float, turn)
            poses.poses.append(Pose(position=place, orientation=turned))
        publisher.publish(poses)
        answer.success, answer.message = True, json.dumps(decision.to_dict())
        return answer

    node.create_service(Trigger, "~/decide", decide)
    rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv)
