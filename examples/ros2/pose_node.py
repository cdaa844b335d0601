"""A ROS 2 node: image, mask and camera_info -> vision_msgs/Detection3DArray and tf.

Topics: image (sensor_msgs/Image, rgb8 or bgr8), mask (sensor_msgs/Image, mono8, 0 outside the object, same stamp as
the image), camera_info (sensor_msgs/CameraInfo of rectified images); detections (vision_msgs/Detection3DArray).
Parameters: mesh (a file in millimetres), cache (folder of the templates), min_score (poses with a lower confidence are
not published), settings (as on the command line).
"""

import message_filters
import numpy as np
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import TransformBroadcaster
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

from pipeline import DzopError, PoseEstimator, PoseResult

CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


class PoseNode(Node):
    """Publishes the pose of one object, in metres, in the optical frame of the image."""

    def __init__(self) -> None:
        super().__init__("dzop")
        for name, default in (("mesh", ""), ("cache", "cache"), ("min_score", 0.5), ("settings", [""])):
            self.declare_parameter(name, default)
        settings = [text for text in self._value("settings") if text]
        self.estimator = PoseEstimator.from_mesh(self._value("mesh"), cache=self._value("cache"), settings=settings)
        self.K: np.ndarray | None = None
        self.detections = self.create_publisher(Detection3DArray, "detections", 10)
        self.tf = TransformBroadcaster(self)
        self.create_subscription(CameraInfo, "camera_info", self.on_camera_info, 10)
        topics = [message_filters.Subscriber(self, Image, name) for name in ("image", "mask")]
        self.pairs = message_filters.TimeSynchronizer(topics, 2)
        self.pairs.registerCallback(self.on_image)

    def _value(self, name: str):
        return self.get_parameter(name).value

    def on_camera_info(self, info: CameraInfo) -> None:
        """Keep the K of the rectified image, from P; if the driver does not rectify, P is 0 and K is used."""
        P, K = np.array(info.p).reshape(3, 4)[:, :3], np.array(info.k).reshape(3, 3)
        self.K = P if P[0, 0] > 0 else K

    def on_image(self, image: Image, mask: Image) -> None:
        """Estimate the pose and publish it; without a pose, publish an empty array."""
        if self.K is None:
            self.get_logger().warning("no camera_info yet")
            return
        try:
            result = self.estimator(to_array(image), self.K, mask=to_array(mask) > 0)
        except (DzopError, ValueError) as error:
            self.get_logger().error(str(error))
            return
        message = Detection3DArray(header=image.header)
        if not result.found:
            self.get_logger().warning(result.summary())
        elif best_score(result) >= self._value("min_score"):
            message.detections.append(self.to_detection(result, image))
            self.tf.sendTransform(to_transform(result, image))
        self.detections.publish(message)

    def to_detection(self, result: PoseResult, image: Image) -> Detection3D:
        """A detection with the pose of the object's origin, and the mesh's bounding box."""
        hypothesis = ObjectHypothesisWithPose()
        hypothesis.hypothesis.class_id, hypothesis.hypothesis.score = result.name, best_score(result)
        set_pose(hypothesis.pose.pose, result)
        detection = Detection3D(header=image.header)
        detection.results.append(hypothesis)
        low, high = (getattr(result.model.mesh.vertices, end)(axis=0) for end in ("min", "max"))
        set_pose(detection.bbox.center, result, offset_mm=(low + high) / 2)
        size = detection.bbox.size
        size.x, size.y, size.z = ((high - low) / 1000).tolist()
        return detection


def best_score(result: PoseResult) -> float:
    """The confidence, or the score if there is no calibration."""
    return float(result.score if result.confidence is None else result.confidence)


def to_array(message: Image) -> np.ndarray:
    """Pixels of an image message, in the order red, green, blue. Raises ValueError for other encodings."""
    if message.encoding not in CHANNELS:
        raise ValueError(f"{message.encoding}: found an unsupported encoding, needs one of {', '.join(CHANNELS)}")
    channels = CHANNELS[message.encoding]
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    pixels = pixels[..., ::-1] if message.encoding == "bgr8" else pixels
    return np.ascontiguousarray(pixels[..., 0] if channels == 1 else pixels)


def set_pose(pose, result: PoseResult, offset_mm=(0.0, 0.0, 0.0)) -> None:
    """Fill a geometry_msgs/Pose, in metres, with the pose of a point of the object frame."""
    T = result.T_cam_obj
    at, turn = pose.position, pose.orientation
    at.x, at.y, at.z = ((T[:3, :3] @ np.asarray(offset_mm) + T[:3, 3]) / 1000).tolist()
    turn.x, turn.y, turn.z, turn.w = result.quaternion_xyzw.tolist()


def to_transform(result: PoseResult, image: Image) -> TransformStamped:
    """The pose as a transform whose parent is the image's frame and whose child frame is named after the object."""
    message = TransformStamped(header=image.header, child_frame_id=result.name)
    at, turn = message.transform.translation, message.transform.rotation
    at.x, at.y, at.z = (result.T_cam_obj[:3, 3] / 1000).tolist()
    turn.x, turn.y, turn.z, turn.w = result.quaternion_xyzw.tolist()
    return message


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = PoseNode()
    try:
        rclpy.spin(node)
    finally:
        node.estimator.close()
        node.destroy_node()


if __name__ == "__main__":
    main()
