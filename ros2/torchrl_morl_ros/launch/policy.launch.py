"""The node alone: give it a policy, and remap its topics to those of your robot."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

TOPICS = {
    "scan": "scan",
    "odom": "odom",
    "human": "human",
    "goal": "goal_pose",
    "preference": "preference",
    "cmd_vel": "cmd_vel",
}


def generate_launch_description() -> LaunchDescription:
    """Arguments: policy, params_file, autostart, use_sim_time, namespace, and the topics."""
    config = PathJoinSubstitution([FindPackageShare("torchrl_morl_ros"), "config", "policy.yaml"])
    arguments = [
        DeclareLaunchArgument("policy", description="folder of the policy"),
        DeclareLaunchArgument("params_file", default_value=config),
        DeclareLaunchArgument("autostart", default_value="true"),
        DeclareLaunchArgument("use_sim_time", default_value="false"),
        DeclareLaunchArgument("namespace", default_value=""),
        *(
            DeclareLaunchArgument(f"{name}_topic", default_value=topic)
            for name, topic in TOPICS.items()
        ),
    ]
    node = LifecycleNode(
        package="torchrl_morl_ros",
        executable="policy_node",
        name="policy_node",
        namespace=LaunchConfiguration("namespace"),
        output="screen",
        parameters=[
            LaunchConfiguration("params_file"),
            {
                "policy": ParameterValue(LaunchConfiguration("policy"), value_type=str),
                "autostart": ParameterValue(LaunchConfiguration("autostart"), value_type=bool),
                "use_sim_time": ParameterValue(
                    LaunchConfiguration("use_sim_time"), value_type=bool
                ),
            },
        ],
        remappings=[
            (topic, LaunchConfiguration(f"{name}_topic")) for name, topic in TOPICS.items()
        ],
    )
    return LaunchDescription([*arguments, node])
