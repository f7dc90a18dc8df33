"""``python -m piezojax.start``; ``--help`` lists its options."""

from .cli.start import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.start")
