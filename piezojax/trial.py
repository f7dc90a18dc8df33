"""``python -m piezojax.trial``; ``--help`` lists its options."""

from .cli.trial import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.trial")
