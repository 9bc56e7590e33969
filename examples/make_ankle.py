"""Makes ankle.csv, the sample recording of this folder: run `python examples/make_ankle.py`.

The truth stands in jaximp/simulation/ankle.py, so that anybody can compare what `jaximp identify examples/ankle.toml`
finds with it.
"""

from pathlib import Path

from jaximp.simulation.ankle import write_ankle_csv

if __name__ == "__main__":
    write_ankle_csv(Path(__file__).with_name("ankle.csv"))
