"""``python -m piezojax.learn``; ``--help`` lists its options."""

from .cli.learn import main

if __name__ == "__main__":
    main(prog_name="python -m piezojax.learn")
