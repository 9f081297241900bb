import sys, time as t
from shift import Shift
from world import Violation
clock = t.process_time
seeds = range(int(sys.argv[1]), int(sys.argv[2]))
start = clock(); true_s = fleet_s = events = 0
for seed in seeds:
    s = Shift(seed, trace=len(sys.argv) > 3)
    b = clock()
    try:
        s.run()
    except Violation as e:
        print("seed", seed, "VIOLATION", e)
    finally:
        if s.world.trace:
            print("\n".join(s.world.trace))
    true_s += s.world.now_s; fleet_s += s.world.now_s * s.speed; events += s.world.events
    cpu = clock() - start
    if len(seeds) < 30: print(seed, f"arms {len(s.arms)} alone {s.alone} speed {s.speed:g} jobs {len(s.jobs)} done {sum(s.finished.values())} t {s.world.now_s:.0f} ev {s.world.events} cpu {clock()-b:.2f}")
print(f"true h {true_s/3600:.1f} fleet h {fleet_s/3600:.1f} cpu {cpu:.1f}; ratio true {true_s/cpu:.0f} fleet {fleet_s/cpu:.0f} events/s {events/cpu:.0f}")
