"""A tracker with Zenoh alone: `python tracker.py ENDPOINT TARGET TRACKER X_M Y_M` publishes five poses a second."""

import json
import sys
import time

import zenoh

endpoint, target, tracker, x_m, y_m = sys.argv[1:]
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
began_ns = time.time_ns()
with zenoh.open(config) as session:
    for seq in range(1, 10**6):
        pose = {
            "key": f"target/{target}/pose",
            "tracker": tracker,
            "incarnation": began_ns,
            "seq": seq,
            "stamp_ns": time.time_ns(),
            "x_m": float(x_m),
            "y_m": float(y_m),
        }  # here comes your radar
        session.put(f"swarm/target/{target}/pose", json.dumps(pose), encoding=zenoh.Encoding.APPLICATION_JSON)
        time.sleep(0.2)
