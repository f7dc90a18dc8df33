"""``python -m piezojax.excite``; ``--help`` lists its options."""

from .cli.excite import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.excite")
