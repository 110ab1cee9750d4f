"""The table of topics: what crosses between the swarm and ROS. Nothing else does.

The gateway and the page of the reference draw from it. The page says of each:

map           Pace of each cell; repeated while it changes.
map_updates   Windows of the map which marks have changed.
tf            Pose of each vehicle: odom frame to base frame.
tf_static     Map frame to the odom frame of each vehicle, at the same place.
odom          Pose and velocity; the velocity is the difference of two reports.
pose          Pose in the map frame.
plan          Each route which the vehicle begins; at most one a second.
fix           Latitude and longitude, on terrain with coordinates; needs pyproj.
poses         Poses of all vehicles, in order of their ids.
targets       Poses of all tracked targets, in order of their ids.
target_pose   Pose of a target, while it is tracked.
markers       For RViz: routes, marked cells, zones, windows of the map which have just changed.
diagnostics   Number of vehicles per state, targets, links, dropped messages.
robot         Position of a robot, which is then a vehicle of the swarm.
goal          Goal of a robot.
robot_plan    The robot's route, on change.
robot_goal    Cell of the target which a robot without a goal follows, on change.
certificate   Cost of each plan and its lower bound, or why there is none.
get_plan      A route to a place or a target.
vehicle_goal  Sends a vehicle of the swarm to a place, where it holds.
pause         Stops all vehicles of the swarm; replies when they obey.
hold          The same.
resume        Starts them again.
set_pose      Moves an external target.
zone          Draws a zone; without corners it is removed.
grid          Closes cells by marks.
map_server    The current map.
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
    """

    name: str
    topic: str
    type_name: str
    qos: Qos
    direction: str
    hz: float | None

    @property
    def per(self) -> str | None:
        """Unit of which each has one: VEHICLE, TARGET, or None."""
        return next((each for each in (VEHICLE, TARGET) if each in self.topic), None)


_OUT, _IN, _SERVICE = "to ROS", "from ROS", "service"
TABLE: tuple[TopicRow, ...] = (
    TopicRow("map", "/map", "nav_msgs/msg/OccupancyGrid", Qos.LATCHED, _OUT, None),
    TopicRow("map_updates", "/map_updates", "map_msgs/msg/OccupancyGridUpdate", Qos.DEFAULT, _OUT, 1.0),
    TopicRow("tf", "/tf", "tf2_msgs/msg/TFMessage", Qos.TRANSFORMS, _OUT, 10.0),
    TopicRow("tf_static", "/tf_static", "tf2_msgs/msg/TFMessage", Qos.LATCHED, _OUT, None),
    TopicRow("odom", "/{vehicle}/odom", "nav_msgs/msg/Odometry", Qos.DEFAULT, _OUT, 10.0),
    TopicRow("pose", "/{vehicle}/pose", "geometry_msgs/msg/PoseStamped", Qos.DEFAULT, _OUT, 10.0),
    TopicRow("plan", "/{vehicle}/plan", "nav_msgs/msg/Path", Qos.LATCHED, _OUT, None),
    TopicRow("fix", "/{vehicle}/fix", "sensor_msgs/msg/NavSatFix", Qos.SENSOR, _OUT, 1.0),
    TopicRow("poses", "/swarm/poses", "geometry_msgs/msg/PoseArray", Qos.DEFAULT, _OUT, 5.0),
    TopicRow("targets", "/targets", "geometry_msgs/msg/PoseArray", Qos.DEFAULT, _OUT, 5.0),
    TopicRow("target_pose", "/targets/{target}/pose", "geometry_msgs/msg/PoseStamped", Qos.DEFAULT, _OUT, 5.0),
    TopicRow("markers", "/swarm/markers", "visualization_msgs/msg/MarkerArray", Qos.LATCHED, _OUT, 1.0),
    TopicRow("diagnostics", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", Qos.DEFAULT, _OUT, 1.0),
)
ROWS = {row.name: row for row in TABLE}
FRAMES = ("tf", "tf_static")
"""Topics that each vehicle has for itself where its frames are bare."""

_POSE, _TRIGGER = "geometry_msgs/msg/PoseStamped", "std_srvs/srv/Trigger"
ROBOT_TABLE: tuple[TopicRow, ...] = (
    TopicRow("robot", "/{robot}/odom", "nav_msgs/msg/Odometry", Qos.SENSOR, _IN, 10.0),
    TopicRow("goal", "/{robot}/goal_pose", _POSE, Qos.DEFAULT, _IN, 10.0),
    TopicRow("robot_plan", "/{robot}/plan", "nav_msgs/msg/Path", Qos.LATCHED, _OUT, None),
    TopicRow("robot_goal", "/{robot}/goal_pose", _POSE, Qos.DEFAULT, _OUT, None),
    TopicRow(
        "certificate", "/{robot}/plan_certificate", "diagnostic_msgs/msg/DiagnosticStatus", Qos.LATCHED, _OUT, None
    ),
    TopicRow("get_plan", "/{robot}/get_plan", "nav_msgs/srv/GetPlan", Qos.DEFAULT, _SERVICE, None),
)
"""For each robot, where the settings let it in."""
VEHICLE_GOAL = TopicRow("vehicle_goal", "/{vehicle}/goal_pose", _POSE, Qos.DEFAULT, _IN, 1.0)
ORDER_TABLE: tuple[TopicRow, ...] = (
    TopicRow("pause", "/swarm/pause", _TRIGGER, Qos.DEFAULT, _SERVICE, None),
    TopicRow("hold", "/swarm/hold", _TRIGGER, Qos.DEFAULT, _SERVICE, None),
    TopicRow("resume", "/swarm/resume", _TRIGGER, Qos.DEFAULT, _SERVICE, None),
    VEHICLE_GOAL,
)
SET_POSE = TopicRow("set_pose", "/targets/{target}/set_pose", _POSE, Qos.DEFAULT, _IN, 10.0)
ZONE = TopicRow("zone", "/works", "geometry_msgs/msg/PolygonStamped", Qos.LATCHED, _IN, 1.0)
GRID = TopicRow("grid", "/seen", "nav_msgs/msg/OccupancyGrid", Qos.LATCHED, _IN, 1.0)
MAP_SERVER = TopicRow("map_server", "/map_server/map", "nav_msgs/srv/GetMap", Qos.DEFAULT, _SERVICE, None)
INCOMING = (*ROBOT_TABLE, SET_POSE, ZONE, GRID, *ORDER_TABLE, MAP_SERVER)
"""All that the settings may let in, and what robots get. The topics of zones and grids are examples: settings name
them."""
POSE_TYPES = {
    "odometry": "nav_msgs/msg/Odometry",
    "pose": "geometry_msgs/msg/PoseStamped",
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}
"""Word in the settings -> type of the topic on which a robot says where it is."""
