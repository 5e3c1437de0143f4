"""ROS 2: a launch file. Static transforms where nothing moves; for the turntable a robot description with a joint.

The turntable needs no node of ours: robot_state_publisher, a part of ROS, turns JointState messages that carry the
reading into the moving transform.
"""

from __future__ import annotations

from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Calibration, TurntableCalibration
from lidarpose.storage.exports import urdf
from lidarpose.storage.exports.common import (
    ExportOptions,
    degrees,
    number,
    require_rigid,
    source_name,
)

_IMPORTS = "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n"


def text(calibration: Calibration, options: ExportOptions) -> str:
    """A Python launch file for ``ros2 launch``."""
    names = options.names
    if isinstance(calibration, TurntableCalibration):
        if options.angle_rad is None:
            return _moving(calibration, options)
        head = f"Where the LiDAR is while the turntable reads {degrees(options.angle_rad)} degrees."
        return _static(head, names.camera, names.lidar, calibration.pose(options.angle_rad))
    require_rigid(calibration, "ros2")
    child = source_name(calibration, names)
    return _static("Where the sensor is in the world.", names.world, child, calibration.T_world_source)


def _static(head: str, parent: str, child: str, pose: Pose) -> str:
    values = zip(
        ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw"),
        (*pose.translation, *pose.quaternion_xyzw),
        strict=True,
    )
    arguments = [word for name, value in values for word in (name, number(value))]
    arguments += ["--frame-id", parent, "--child-frame-id", child]
    rows = [", ".join(f'"{word}"' for word in arguments[k : k + 2]) for k in range(0, len(arguments), 2)]
    listed = "".join(f"                    {row},\n" for row in rows)
    return f"""# {head}
# Direction: p_{parent} = T p_{child}. Metres; quaternion x y z w.
# By hand: ros2 run tf2_ros static_transform_publisher {" ".join(arguments)}
{_IMPORTS}

def generate_launch_description():
    return LaunchDescription(
        [
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                name="lidarpose_static_transform",
                arguments=[
{listed}                ],
            ),
        ]
    )
"""


def _moving(calibration: TurntableCalibration, options: ExportOptions) -> str:
    names = options.names
    # The description holds no quotation marks of Python's triple kind and no backslashes: names are checked.
    description = urdf.text(calibration, options)
    return f'''# Where the LiDAR is as the turntable turns.
# Direction: p_{names.camera} = T(reading) p_{names.lidar}. Metres and radians.
# No node of its own: robot_state_publisher makes the transforms from sensor_msgs/JointState messages on the topic
# /joint_states that carry the turntable's reading in radians under the name "{urdf.JOINT}". To try it:
#   ros2 topic pub /joint_states sensor_msgs/msg/JointState "{{name: [{urdf.JOINT}], position: [0.0]}}"
#   ros2 run tf2_ros tf2_echo {names.camera} {names.lidar}
{_IMPORTS}from launch_ros.parameter_descriptions import ParameterValue

ROBOT_DESCRIPTION = """\\
{description}"""


def generate_launch_description():
    return LaunchDescription(
        [
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                name="lidarpose_state_publisher",
                # As a string: launch takes plain text for YAML, and trips over its colons.
                parameters=[{{"robot_description": ParameterValue(ROBOT_DESCRIPTION, value_type=str)}}],
            ),
        ]
    )
'''
