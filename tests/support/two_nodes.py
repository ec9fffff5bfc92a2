"""A sweep on a Ray cluster of two nodes on this machine, of which one is killed midway.

    python two_nodes.py GRID OUT [kill|keep] [FAKE]

Runs the grid, or, where FAKE is the command of a stand-in for runs, six naps. Prints a line of
JSON: how many nodes took part, whether one was killed, how far the runs are, how many attempts
there were.
"""

import json
import sys
from pathlib import Path

from ray.cluster_utils import Cluster

from crossgrad_plugins.sweep.app import Request, Sweep
from crossgrad_plugins.sweep.engines import Work, engine
from crossgrad_plugins.sweep.job import Job, Layout
from crossgrad_plugins.sweep.run_status import read_records, standings

#: A node that is gone is missed within a second or two, not in the fifteen of Ray's defaults.
SOON = {
    "health_check_initial_delay_ms": 500,
    "health_check_period_ms": 500,
    "health_check_failure_threshold": 2,
}


def main():
    """Runs it."""
    grid, out, kill = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] == "kill"
    head = {"num_cpus": 1, "_system_config": SOON}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    other = cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    work = made(grid, out, sys.argv[4:], cluster.address)
    killed = False
    for _ in engine("ray")(work):
        records = read_records(out / "workers")
        there = [each for each in records if node(each) == other.node_id[:8]]
        ended = [each for each in records if each.event == "ended"]
        if kill and not killed and ended and there and there[-1].event == "begun":
            killed = True
            cluster.remove_node(other, allow_graceful=False)
    records = read_records(out / "workers")
    found = standings(work.jobs, Layout(out), records, alive=False)
    cluster.shutdown()
    said = {
        "nodes": len({node(each) for each in records}),
        "killed": killed,
        "states": [each.state for each in found],
        "begins": sum(each.event == "begun" for each in records),
    }
    sys.stdout.write(json.dumps(said) + "\n")


def node(record):
    return record.worker.split("-")[1]


def made(grid, out, fake, address):
    layout = Layout(out.absolute())
    layout.make()
    if fake:
        jobs = [Job(f"nap-{n}", "nap", "scene", n, {"do": "nap"}) for n in range(6)]
    else:
        jobs = Sweep(Request(grid, out, engine="ray")).plan.jobs
    more = {"command": tuple(fake)} if fake else {}
    options = {"address": address}
    return Work(jobs, layout.out, grid.resolve().parent, 1, options=options, **more)


if __name__ == "__main__":
    main()
