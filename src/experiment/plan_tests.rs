use super::*;
use crate::experiment::factor::of;
use crate::experiment::plans::READY;

fn parse(text: &str) -> Result<Plan, PlanError> {
    Plan::parse("a.toml", text, Path::new("."))
}

fn refused(text: &str) -> String {
    parse(text).unwrap_err().to_string()
}

#[test]
fn factors_are_crossed_and_a_method_is_run_once_for_what_concerns_it() {
    let plan = parse(
        "[factors]\nmethod = [\"ours\", \"hold\", \"floor\"]\nmotion = \"on-model\"\n\
         link = [\"delay 50ms\", \"delay 0.1s loss 1%\"]\nfuture = [\"1 sigma\", \"20mm\"]\nlink_seed = \"1..3\"\n",
    )
    .unwrap();
    let count = |method: &str| {
        let cells = plan.cells.iter();
        cells.filter(|c| of(&c.texts, "method") == method).count()
    };
    assert_eq!((count("ours"), count("hold"), count("floor")), (12, 6, 1));
    let both = |c: &&Cell| of(&c.texts, "method") == "ours";
    assert!(
        plan.cells
            .iter()
            .filter(both)
            .all(|c| of(&c.texts, "up") == of(&c.texts, "down"))
    );
}

#[test]
fn a_case_changes_only_what_it_names() {
    let text = "seed = 9\n[factors]\nmotion = \"on-model\"\nmethod = \"ours\"\nbandwidth = 30\n\
                [[case]]\nup = \"delay 10ms\"\n[[case]]\nscale = [0.1, 0.2]\n";
    let plan = parse(text).unwrap();
    assert_eq!((plan.seed, plan.cells.len()), (9, 3));
    assert!(plan.cells.iter().all(|c| c.settings.omega == 30.0));
    assert_eq!(plan.cells[0].settings.up.delay_s, 0.01);
    assert_eq!(plan.cells[0].settings.down.delay_s, 0.1);
    assert_eq!(plan.cells[2].settings.scale, Some(0.2));
}

#[test]
fn what_is_said_of_one_direction_counts_wherever_it_stands() {
    for way in ["up", "down"] {
        let plan = parse(&format!(
            "[factors]\n{way} = \"delay 50ms\"\nlink = \"perfect\"\n"
        ));
        let cells = plan.unwrap().cells;
        let ours = cells.iter().find(|c| of(&c.texts, "method") == "ours");
        let delays = ours.map(|c| (c.settings.up.delay_s, c.settings.down.delay_s));
        let expected = if way == "up" {
            (0.05, 0.0)
        } else {
            (0.0, 0.05)
        };
        assert_eq!(delays, Some(expected));
    }
}

#[test]
fn axes_are_those_of_generated_hands_too() {
    let plan = parse("[motion]\npeople = 2\naxes = \"base\"\n").unwrap();
    assert_eq!(plan.motion.axes, Axes::Base);
}

#[test]
fn what_is_wrong_is_named_with_its_line() {
    for (text, said) in [
        ("[factors]\ndelay = 3\n", "a.toml:2: unknown factor `delay`"),
        (
            "\n[motion]\npersons = 3\n",
            "a.toml:3: unknown key `persons`",
        ),
        ("title = \"x\"\nsede = 3\n", "a.toml:2: unknown key `sede`"),
        (
            "[factors]\nlink = [\n  \"delay 5ms\",\n  \"dely 5ms\",\n]\n",
            "a.toml:4: up = \"dely 5ms\"",
        ),
        (
            "[factors]\narm = \"nowhere.urdf\"\n",
            "a.toml:2: arm = \"nowhere.urdf\"",
        ),
        (
            "[motion]\nfolders = [\"no/such/folder\"]\n",
            "no such folder",
        ),
        (
            "[factors]\nmethod = []\n",
            "a.toml:2: `method` names no value",
        ),
        ("[factors]\nlink_seed = \"9..2\"\n", "a.toml:2: link_seed"),
        ("[factors]\nmethod = \"ours\n", "a.toml:2:"),
        (
            "[motion]\npeople = 2\nevery = true\n",
            "a.toml:3: `every` does nothing without `folders`",
        ),
        (
            "[motion]\nfolders = [\".\"]\nwrist = true\n",
            "a.toml:3: `wrist` does nothing beside `folders`",
        ),
        ("seed = 0x10\n", "a.toml:1: `seed` must be"),
        (
            "[factors]\nlink_seed = 0x11\n",
            "a.toml:2: `link_seed` must be",
        ),
        (
            "[factors]\nlink_seed = \"1..1000000\"\nscale = [0.1, 0.2]\n",
            "runs a person",
        ),
    ] {
        let message = refused(text);
        assert!(message.contains(said), "{message}");
    }
}

#[test]
fn every_ready_plan_is_one_and_drives_what_was_not_demonstrated() {
    for (name, text) in READY {
        let plan = Plan::parse(name, text, Path::new(".")).unwrap();
        let off = plan.cells.iter().filter(|c| !c.settings.on_model).count();
        assert!(
            off > 0 && off < plan.cells.len() || name == "off-model",
            "{name}"
        );
        let has = |method| plan.cells.iter().any(|c| of(&c.texts, "method") == method);
        assert!(has("ours") && has("hold") && has("floor"), "{name}");
    }
}
