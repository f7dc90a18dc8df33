"""``python -m piezojax.emulate``; ``--help`` lists its options."""

from .cli.emulate import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.emulate")
