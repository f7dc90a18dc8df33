"""``python -m piezojax.reproduce``; ``--help`` lists its options."""

from .cli.reproduce import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.reproduce")
