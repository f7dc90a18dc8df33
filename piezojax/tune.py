"""``python -m piezojax.tune``; ``--help`` lists its options."""

from .cli.tune import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.tune")
