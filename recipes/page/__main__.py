"""Build a page to play with: one HTML file, which needs no server and no network.

Drag what matters to the robot, as it drives; drag the person, the goal and the boxes; say which of two drives you
like better, and it finds what matters to you; record drives of your own::

    python -m recipes.page

It holds the shipped policies and scenes, or others::

    python -m recipes.page --policy runs/teach/mine/pd_morl/policies/last --scene doorway.yaml
"""

from __future__ import annotations

from pathlib import Path

from recipes.arguments import Parser, count
from recipes.outputs import choose_file
from recipes.policy_folders import policy_folder

from .choices import choices
from .contents import NUM_SCENES, SCENES, SHIPPED, contents
from .html import html


def main() -> None:
    """Build it; ``--help`` lists the options."""
    parser = Parser(prog="python -m recipes.page", description=__doc__)
    parser.add_argument(
        "--policy",
        type=policy_folder,
        nargs="+",
        default=list(SHIPPED),
        metavar="FOLDER",
        help="policies, the first is shown first (default: navigation and polished_seed0)",
    )
    parser.add_argument(
        "--scene",
        nargs="+",
        default=list(SCENES),
        metavar="SCENE",
        help=f"names or .yaml files, the first is shown first (default: {' '.join(SCENES)})",
    )
    parser.add_argument(
        "--seeds",
        type=count(1, 1_000),
        default=NUM_SCENES,
        metavar="N",
        help="scenes of each kind (default: %(default)s)",
    )
    parser.add_argument(
        "--without-choices",
        action="store_true",
        help="leave out which drive one likes better, for which a policy that is not shipped drives for "
        "some minutes, once",
    )
    parser.add_argument(
        "--output",
        type=Path,
        help="new .html file (default: runs/page/index.html, or index-2.html)",
    )
    args = parser.parse_args()
    try:
        output = choose_file(args.output, Path("runs/page/index.html"))
        if output.suffix != ".html":
            raise ValueError(f"--output must end in .html, got {output.name!r}.")
        held = contents(args.policy, args.scene, num_scenes=args.seeds)
        if not args.without_choices:
            held["choices"] = choices(args.policy[0])
            if held["choices"] is None:
                print(
                    f'note: without "You choose", since drives of {args.policy[0]} cannot be compared'
                )
        text = html(held)
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    print(f"page: {output} ({len(text.encode()) / 1e6:.1f} MB), open it in a browser")


if __name__ == "__main__":
    main()
