"""Ask a node of ROS 2 for its parameters, as ros2 param does, and write them as a JSON line."""

import json
import sys

import rclpy
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient


def main():
    """Ask the node that the first argument names, and try to set ``queue_frames``."""
    rclpy.init()
    node = rclpy.create_node("asks")
    client = AsyncParameterClient(node, sys.argv[1])
    client.wait_for_services(30.0)

    def asked(future):
        rclpy.spin_until_future_complete(node, future, timeout_sec=30.0)
        return future.result()

    names = asked(client.list_parameters()).result.names
    values = map(parameter_value_to_python, asked(client.get_parameters(names)).values)
    described = asked(client.describe_parameters(names)).descriptors
    (change,) = asked(client.set_parameters([Parameter("queue_frames", value=7)])).results
    print(json.dumps({
        "kind": "parameters", "values": dict(zip(names, values, strict=True)), "set": change.successful,
        "described": {each.name: each.description for each in described},
    }), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
