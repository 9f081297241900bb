"""Print the load of fleets of up to 10 000 arms, by calculation: `python -m benchmarks.scaling`.

The sizes of the messages are those of encoded examples, the rates those of the contract, and the costs per message
those that `costs.py` measures.
"""

from benchmarks.scaling.load import print_loads

if __name__ == "__main__":
    print_loads()
