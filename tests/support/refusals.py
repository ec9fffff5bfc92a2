"""The refusals of crossgrad's own combinations, as lines and back.

    python -m support.refusals > tests/matrix/refusals.txt

writes down the refusals of what is installed from the distribution `crossgrad`, in as few lines as
say exactly the same: a reason that depends on the sampler and the operator alone is one line for
all backbones and densifiers.
"""

import sys
from functools import cache

from crossgrad_core.registry.entries import load, offers
from crossgrad_core.testing.support.short_runs import reasons_to_refuse
from crossgrad_plugins.authoring.matrix.combinations import SLOTS, as_lines, config_of, every_row


@cache
def every_combination():
    """One name per slot, all there are of crossgrad's own.

    Of the rasterizers those that run on a CPU: the others are refused here, whatever else is named.
    """
    names = {
        slot: [each.name for each in offers(f"{slot}s") if each.distribution == "crossgrad"]
        for slot in SLOTS
    }
    on_cpu = [name for name in names["rasterizer"] if "cpu" in load("rasterizers", name).devices]
    return every_row({**names, "rasterizer": on_cpu})


def refused(rows):
    """The reasons for which combinations are refused; those that work are not there."""
    found = {row: reasons_to_refuse(config_of(row)) for row in rows}
    return {row: reasons for row, reasons in found.items() if reasons}


def from_lines(lines, rows):
    """The refusals that lines of `as_lines` stand for."""
    # The places that lines name -> the names there -> reasons: few lines name other places.
    patterns = {}
    for line in lines:
        named, reason = line.split(": ", 1)
        parts = [part.split("=", 1) for part in named.split()]
        places = tuple(SLOTS.index(slot) for slot, _ in parts)
        names = tuple(name for _, name in parts)
        patterns.setdefault(places, {}).setdefault(names, []).append(reason)
    found = {}
    for row in rows:
        for places, reasons in patterns.items():
            names = tuple(row[i] for i in places)
            if names in reasons:
                found.setdefault(row, []).extend(reasons[names])
    return found


if __name__ == "__main__":
    everything = every_combination()
    sys.stdout.writelines(f"{line}\n" for line in as_lines(refused(everything), everything))
