"""``python -m piezojax.retune``; ``--help`` lists its options."""

from .cli.retune import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.retune")
