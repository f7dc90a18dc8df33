"""``python -m piezojax.identify``; ``--help`` lists its options."""

from .cli.identify import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.identify")
