"""``python -m piezojax.watch``; ``--help`` lists its options."""

from .cli.watch import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.watch")
