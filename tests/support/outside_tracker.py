"""A tracker as an outsider would write it: plain Zenoh and msgpack, nothing of this project's code.

Usage: python outside_tracker.py ENDPOINT SCHEMA TARGET TRACKER X_M Y_M. Tells five times a second where the
target is, until it is killed; on SIGTERM it hands the target over.
"""

import json
import signal
import sys
import time

import msgspec
import zenoh

endpoint, schema, target, tracker, x_m, y_m = sys.argv[1:]
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([endpoint]))
began_ns, leaves = time.time_ns(), []
signal.signal(signal.SIGTERM, lambda *_: leaves.append(True))
with zenoh.open(config) as session:
    seq = 0
    while True:
        seq += 1
        over = bool(leaves)
        pose = {
            "schema": schema, "target": target, "tracker": tracker, "incarnation": began_ns, "seq": seq,
            "stamp_ns": time.time_ns(), "lease_s": 0.0 if over else 2.0, "x_m": float(x_m), "y_m": float(y_m),
        }  # fmt: skip
        session.put(f"swarm/target/{target}/pose", msgspec.msgpack.encode(pose))
        if over:
            break
        time.sleep(0.2)
