"""The table of topics: what crosses between the swarm and ROS. Nothing else does.

The gateway and the page of the reference draw from it.
"""

from __future__ import annotations

from dataclasses import dataclass

from launch_scripts.gateways.ros2.rmw import Qos

VEHICLE, TARGET, ROBOT = "{vehicle}", "{target}", "{robot}"
"""Stand in names for that of each vehicle, target or robot."""


@dataclass(frozen=True, slots=True)
class TopicRow:
    """One topic, or one for each vehicle or target.

    name       by which settings call it
    topic      its name in ROS unless settings say otherwise; with {vehicle} or {target} there is one for each
    type_name  such as nav_msgs/msg/Path
    hz         how often it is put, at most; None: when something changes
    says       what it tells, in a sentence
    """

    name: str
    topic: str
    type_name: str
    qos: Qos
    direction: str
    hz: float | None
    says: str

    @property
    def per(self) -> str | None:
        """Unit of which each has one: VEHICLE, TARGET, or None."""
        return next((each for each in (VEHICLE, TARGET) if each in self.topic), None)


_OUT, _IN, _SERVICE = "to ROS", "from ROS", "service"
TABLE: tuple[TopicRow, ...] = (
    TopicRow("map", "/map", "nav_msgs/msg/OccupancyGrid", Qos.LATCHED, _OUT, None,
             "Pace of each cell; repeated while it changes."),
    TopicRow("map_updates", "/map_updates", "map_msgs/msg/OccupancyGridUpdate", Qos.DEFAULT, _OUT, 1.0,
             "Windows of the map which marks have changed."),
    TopicRow("tf", "/tf", "tf2_msgs/msg/TFMessage", Qos.TRANSFORMS, _OUT, 10.0,
             "Pose of each vehicle: odom frame to base frame."),
    TopicRow("tf_static", "/tf_static", "tf2_msgs/msg/TFMessage", Qos.LATCHED, _OUT, None,
             "Map frame to the odom frame of each vehicle, at the same place."),
    TopicRow("odom", "/{vehicle}/odom", "nav_msgs/msg/Odometry", Qos.DEFAULT, _OUT, 10.0,
             "Pose and velocity; the velocity is the difference of two reports."),
    TopicRow("pose", "/{vehicle}/pose", "geometry_msgs/msg/PoseStamped", Qos.DEFAULT, _OUT, 10.0,
             "Pose in the map frame."),
    TopicRow("plan", "/{vehicle}/plan", "nav_msgs/msg/Path", Qos.LATCHED, _OUT, None,
             "Each route which the vehicle begins; at most one a second."),
    TopicRow("fix", "/{vehicle}/fix", "sensor_msgs/msg/NavSatFix", Qos.SENSOR, _OUT, 1.0,
             "Latitude and longitude, on terrain with coordinates; needs pyproj."),
    TopicRow("poses", "/swarm/poses", "geometry_msgs/msg/PoseArray", Qos.DEFAULT, _OUT, 5.0,
             "Poses of all vehicles, in order of their ids."),
    TopicRow("targets", "/targets", "geometry_msgs/msg/PoseArray", Qos.DEFAULT, _OUT, 5.0,
             "Poses of all tracked targets, in order of their ids."),
    TopicRow("target_pose", "/targets/{target}/pose", "geometry_msgs/msg/PoseStamped", Qos.DEFAULT, _OUT, 5.0,
             "Pose of a target, while it is tracked."),
    TopicRow("markers", "/swarm/markers", "visualization_msgs/msg/MarkerArray", Qos.LATCHED, _OUT, 1.0,
             "For RViz: routes, marked cells, zones, windows of the map which have just changed."),
    TopicRow("diagnostics", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", Qos.DEFAULT, _OUT, 1.0,
             "Number of vehicles per state, targets, links, dropped messages."),
)  # fmt: skip
ROWS = {row.name: row for row in TABLE}
FRAMES = ("tf", "tf_static")
"""Topics that each vehicle has for itself where its frames are bare."""

_POSE, _TRIGGER = "geometry_msgs/msg/PoseStamped", "std_srvs/srv/Trigger"
ROBOT_TABLE: tuple[TopicRow, ...] = (
    TopicRow("robot", "/{robot}/odom", "nav_msgs/msg/Odometry", Qos.SENSOR, _IN, 10.0,
             "Position of a robot, which is then a vehicle of the swarm."),
    TopicRow("goal", "/{robot}/goal_pose", _POSE, Qos.DEFAULT, _IN, 10.0, "Goal of a robot."),
    TopicRow("robot_plan", "/{robot}/plan", "nav_msgs/msg/Path", Qos.LATCHED, _OUT, None,
             "The robot's route, on change."),
    TopicRow("robot_goal", "/{robot}/goal_pose", _POSE, Qos.DEFAULT, _OUT, None,
             "Cell of the target which a robot without a goal follows, on change."),
    TopicRow("certificate", "/{robot}/plan_certificate", "diagnostic_msgs/msg/DiagnosticStatus", Qos.LATCHED, _OUT,
             None, "Cost of each plan and its lower bound, or why there is none."),
    TopicRow("get_plan", "/{robot}/get_plan", "nav_msgs/srv/GetPlan", Qos.DEFAULT, _SERVICE, None,
             "A route to a place or a target."),
)  # fmt: skip
"""For each robot, where the settings let it in."""
VEHICLE_GOAL = TopicRow("vehicle_goal", "/{vehicle}/goal_pose", _POSE, Qos.DEFAULT, _IN, 1.0,
                        "Sends a vehicle of the swarm to a place, where it holds.")  # fmt: skip
ORDER_TABLE: tuple[TopicRow, ...] = (
    TopicRow("pause", "/swarm/pause", _TRIGGER, Qos.DEFAULT, _SERVICE, None,
             "Stops all vehicles of the swarm; replies when they obey."),
    TopicRow("hold", "/swarm/hold", _TRIGGER, Qos.DEFAULT, _SERVICE, None, "The same."),
    TopicRow("resume", "/swarm/resume", _TRIGGER, Qos.DEFAULT, _SERVICE, None, "Starts them again."),
    VEHICLE_GOAL,
)  # fmt: skip
SET_POSE = TopicRow("set_pose", "/targets/{target}/set_pose", _POSE, Qos.DEFAULT, _IN, 10.0,
                    "Moves an external target.")  # fmt: skip
ZONE = TopicRow("zone", "/works", "geometry_msgs/msg/PolygonStamped", Qos.LATCHED, _IN, 1.0,
                "Draws a zone; without corners it is removed.")  # fmt: skip
GRID = TopicRow("grid", "/seen", "nav_msgs/msg/OccupancyGrid", Qos.LATCHED, _IN, 1.0, "Closes cells by marks.")
MAP_SERVER = TopicRow("map_server", "/map_server/map", "nav_msgs/srv/GetMap", Qos.DEFAULT, _SERVICE, None,
                      "The current map.")  # fmt: skip
INCOMING = (*ROBOT_TABLE, SET_POSE, ZONE, GRID, *ORDER_TABLE, MAP_SERVER)
"""All that the settings may let in, and what robots get. The topics of zones and grids are examples: settings name
them."""
POSE_TYPES = {
    "odometry": "nav_msgs/msg/Odometry",
    "pose": "geometry_msgs/msg/PoseStamped",
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}
"""Word in the settings -> type of the topic on which a robot says where it is."""
