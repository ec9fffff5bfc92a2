"""Prints what the package and some of its extras need, but for torch and what builds on it.

    python tests/beside_torch.py test,lint > needs.txt

torch is half of all bytes: these packages are installed at the same time.
"""

import sys

from lowest import requirements

if __name__ == "__main__":
    every = requirements(sys.argv[1].split(","))
    sys.stdout.write("".join(f"{each}\n" for each in every if not each.startswith("torch")))
