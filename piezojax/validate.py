"""``python -m piezojax.validate``; ``--help`` lists its options."""

from .cli.validate import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.validate")
