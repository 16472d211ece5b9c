//! Settings: every one by flag, environment and file, in that order; and a file looked at before a daemon is started with it.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};

use clap::Parser;
use serde_json::Value;
use telemime_endpoint::config::{Kind, Layers, Settings, example, schema};
use telemime_operator::cli::Args as Operator;
use telemime_robot::cli::Args as Robot;

#[derive(Parser)]
struct Line<D: Settings> {
    #[command(flatten)]
    args: D,
}

/// For a key: a value in the file, one in the environment, one by flag; all different.
fn values() -> BTreeMap<&'static str, [&'static str; 3]> {
    let key = |c| -> &'static str { Box::leak(format!("{c}").repeat(64).into_boxed_str()) };
    let quoted = |c| -> &'static str { Box::leak(format!("[\"{}\"]", key(c)).into_boxed_str()) };
    let text = |c| -> &'static str { Box::leak(format!("\"{}\"", key(c)).into_boxed_str()) };
    BTreeMap::from([
        ("listen", ["\"127.0.0.1:1\"", "127.0.0.1:2", "127.0.0.1:3"]),
        ("connect", ["\"a:1\"", "b:2", "c:3"]),
        ("identity", ["\"a.key\"", "b.key", "c.key"]),
        ("peers", [quoted('a'), key('b'), key('c')]),
        ("peer", [text('a'), key('b'), key('c')]),
        ("peer_file", ["\"a\"", "b", "c"]),
        ("name", ["\"a\"", "1234", "c"]),
        ("clock_dispersion", ["\"50us\"", "60us", "70us"]),
        ("urdf", ["\"a.urdf\"", "b.urdf", "c.urdf"]),
        ("tip", ["\"a\"", "b", "c"]),
        ("fixed", ["{ j = 0.1 }", "{ j = 0.2 }", "j=0.3"]),
        ("start", ["[0.1]", "[0.2]", "0.3"]),
        ("payload", ["\"1\"", "2@0,0,0.1", "3"]),
        ("keep_above_m", ["0.1", "0.2", "0.3"]),
        (
            "planes",
            ["[[1.0, 0.0, 0.0, 0.1]]", "[[1.0, 0.0, 0.0, 0.2]]", ""],
        ),
        ("self_collision", ["true", "false", ""]),
        ("stop_distance_m", ["0.01", "0.02", ""]),
        ("slow_distance_m", ["0.1", "0.2", ""]),
        (
            "contact_plane",
            ["[0.0, 0.0, 1.0, 0.1]", "[0.0, 0.0, 1.0, 0.2]", "0,0,1,0.3"],
        ),
        ("dead_time_s", ["0.01", "0.02", "30ms"]),
        ("bandwidth_rad_s", ["41", "42", "43"]),
        ("stiffness_nm_rad", ["100", "200", "300"]),
        ("protocol_max", ["1", "2", "1"]),
        ("record", ["\"a.csv\"", "b.csv", "c.csv"]),
        ("driver", ["\"a\"", "true", "c"]),
        ("driver_patience_s", ["0.1", "0.2", "300ms"]),
        ("realtime", ["41", "42", "43"]),
        ("black_box", ["\"a\"", "b", "c"]),
        ("metrics", ["\"127.0.0.1:1\"", "127.0.0.1:2", "127.0.0.1:3"]),
        (
            "foxglove",
            ["\"127.0.0.1:1\"", "127.0.0.1:2", "127.0.0.1:3"],
        ),
        ("log_format", ["\"text\"", "json", "text"]),
        ("learn", ["[\"a\"]", "b, c", "d"]),
        ("match", ["\"a*\"", "[0-9]*", "c*"]),
        ("skills", ["[\"a.skill\"]", "b.skill", "c.skill"]),
        ("replay", ["\"a.csv\"", "[\"b.csv\", \"c.csv\"]", "d.csv"]),
        ("refine", ["false", "true", ""]),
        ("play", ["\"a\"", "b", "c"]),
        ("console", ["\"127.0.0.1:1\"", "127.0.0.1:2", "127.0.0.1:3"]),
        (
            "frames",
            [
                "{ goal = [0.1, 0.0, 0.0] }",
                "{ goal = [0.2, 0.0, 0.0] }",
                "goal=0.3,0,0",
            ],
        ),
        ("correct", ["\"a.csv\"", "b.csv", "c.csv"]),
        ("hand_sigma_m", ["0.01", "0.02", "0.03"]),
        ("bound_m", ["0.01", "0.02", "0.03"]),
        ("turn_bound_rad", ["0.01", "0.02", "0.03"]),
        ("scale", ["0.1", "0.2", "0.3"]),
        ("axes", ["\"kinect\"", "base", "kinect"]),
        ("gain", ["0.1", "0.2", "0.3"]),
        ("future_bound", ["\"10mm\"", "20mm", "0.4way"]),
        ("path_bound_m", ["0.01", "0.02", "0.03"]),
        ("path_turn_bound_rad", ["0.01", "0.02", "0.03"]),
        ("max_silence_s", ["0.1", "0.15", "0.2"]),
        ("min_interval_s", ["0.01", "0.02", "0.03"]),
        ("lease_s", ["0.5", "0.6", "0.7"]),
        ("rest_s", ["1", "2", "3"]),
        ("patience_s", ["1", "2", "3"]),
        ("seed", ["1", "2", "3"]),
        ("input.source", ["\"-\"", "udp:5005", "depth:-"]),
        ("input.from", ["\"10.0.0.1\"", "10.0.0.2", "10.0.0.3"]),
        ("input.joint", ["\"a\"", "b", "c"]),
        ("input.unit", ["\"m\"", "cm", "mm"]),
        ("input.time_unit", ["\"ms\"", "us", "ns"]),
        ("input.grip_range", ["\"0,1\"", "0,2", "0,3"]),
        (
            "input.camera",
            ["\"571,571,320,240\"", "572,572,320,240", "573,573,320,240"],
        ),
        ("input.mirror", ["false", "true", ""]),
        ("input.frame_size", ["\"640x480\"", "320x240", "160x120"]),
        ("input.fps", ["10", "20", "30"]),
        ("input.stick_speed_m_s", ["0.1", "0.2", "0.3"]),
        ("input.engage", ["false", "true", ""]),
        ("input.until_end", ["false", "true", ""]),
        ("input.latency_ms", ["10", "20", "30ms"]),
        ("input.glitch_gate", ["false", "true", ""]),
    ])
}

/// What a daemon makes of a file, an environment and flags.
fn settled<D: Settings>(
    dir: &Path,
    file: &str,
    environment: &[(String, String)],
    flags: &[&str],
) -> String {
    let path = dir.join("daemon.toml");
    std::fs::write(&path, file).unwrap();
    let below = Layers::read::<D>(Some(&path), environment).table().unwrap();
    let line = std::iter::once("daemon").chain(flags.iter().copied());
    let args = Line::<D>::try_parse_from(line).unwrap().args;
    format!("{:?}", args.over(below).unwrap())
}

/// What some settings mean nothing without.
fn needs(key: &str) -> &'static str {
    match key {
        "frames" | "correct" => "play = \"a\"\n",
        "refine" => "replay = \"a.csv\"\n",
        _ => "",
    }
}

fn in_file(key: &str, value: &str) -> String {
    match key.split_once('.') {
        Some((of, key)) => format!("{}[{of}]\n{key} = {value}\n", needs(key)),
        None => format!("{}{key} = {value}\n", needs(key)),
    }
}

fn precedence<D: Settings>() {
    let (sheet, values) = (D::sheet(), values());
    let dir = tempfile::tempdir().unwrap();
    for setting in &sheet.settings {
        let key = setting.key;
        let [file, variable, flag] = values
            .get(key)
            .unwrap_or_else(|| panic!("no values for {key}"));
        let environment = [(sheet.variable(setting), (*variable).to_owned())];
        let alone = in_file(key, file);
        let toml = match setting.kind {
            Kind::Text | Kind::Choice(_) => format!("{variable:?}"),
            Kind::Texts => {
                let parts: Vec<_> = variable.split(", ").collect();
                format!("{parts:?}")
            }
            _ => (*variable).to_owned(),
        };
        let by_file = settled::<D>(dir.path(), &alone, &[], &[]);
        let by_variable = settled::<D>(dir.path(), &alone, &environment, &[]);
        assert_ne!(
            by_file, by_variable,
            "{key}: the environment comes before the file"
        );
        let the_same = settled::<D>(dir.path(), &in_file(key, &toml), &[], &[]);
        assert_eq!(by_variable, the_same, "{key}: both mean the same");
        let Some(long) = setting.flag.filter(|_| !flag.is_empty()) else {
            continue;
        };
        let flag = format!("--{long}={flag}");
        let by_flag = settled::<D>(dir.path(), &alone, &environment, &[&flag]);
        assert_eq!(
            by_flag,
            settled::<D>(dir.path(), needs(key), &[], &[&flag]),
            "{key}: the flag comes before both"
        );
        if key != "protocol_max" && key != "log_format" && key != "axes" {
            assert_ne!(by_flag, by_file, "{key}");
        }
        assert_ne!(by_flag, by_variable, "{key}");
    }
}

#[test]
fn every_setting_of_both_daemons_comes_by_flag_then_environment_then_file() {
    precedence::<Robot>();
    precedence::<Operator>();
}

#[test]
fn what_the_environment_does_replaces_what_the_file_does() {
    let dir = tempfile::tempdir().unwrap();
    let play = [("TELEMIME_OPERATOR_PLAY".to_owned(), "wave".to_owned())];
    let settled = settled::<Operator>(dir.path(), "replay = \"a.csv\"\n", &play, &[]);
    assert!(
        settled.contains("play: Some(\"wave\")") && settled.contains("replay: []"),
        "{settled}"
    );
    let typo = [("TELEMIME_ROBOT_LISTN".to_owned(), "1.2.3.4:5".to_owned())];
    let wrong = Layers::read::<Robot>(None, &typo).table().unwrap_err();
    assert!(
        wrong
            .to_string()
            .contains("did you mean TELEMIME_ROBOT_LISTEN?"),
        "{wrong}"
    );
}

/// The block of docs/commands.md is what is printed; `TELEMIME_WRITE_DOCS=1` writes it there.
fn documented<D: Settings>() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/commands.md");
    let text = std::fs::read_to_string(&path).unwrap();
    let begin = format!("```toml {}\n", D::sheet().daemon);
    let (before, rest) = text.split_once(&begin).unwrap();
    let (block, after) = rest.split_once("```").unwrap();
    let printed = example::<D>();
    if std::env::var_os("TELEMIME_WRITE_DOCS").is_some() {
        std::fs::write(&path, format!("{before}{begin}{printed}```{after}")).unwrap();
    } else {
        assert_eq!(block, printed, "TELEMIME_WRITE_DOCS=1 makes it so");
    }
}

#[test]
fn the_documented_configuration_is_the_printed_one() {
    documented::<Robot>();
    documented::<Operator>();
}

/// The example, and every line of it that sets something, taken one by one.
fn examples<D: Settings>() {
    let text = example::<D>();
    assert!(text.parse::<toml::Table>().unwrap().is_empty());
    let (mut table, mut there) = (String::new(), Vec::new());
    for line in text.lines().filter_map(|line| line.strip_prefix('#')) {
        if line.starts_with('[') {
            table = format!("{line}\n");
        } else if !line.starts_with(' ') {
            let key = line.split(" = ").next().unwrap();
            there.push(match table.trim_matches(['[', ']', '\n']) {
                "" => key.to_owned(),
                of => format!("{of}.{key}"),
            });
            let one: toml::Table = format!("{table}{line}").parse().unwrap();
            let args = D::default().over(one).unwrap();
            args.judge().unwrap_or_else(|e| panic!("{line}: {e:#}"));
        }
    }
    there.sort();
    let mut known: Vec<_> = D::sheet()
        .settings
        .iter()
        .map(|s| s.key.to_owned())
        .collect();
    known.sort();
    assert_eq!(there, known);
    let undescribed = text.lines().find(|line| line.trim() == "#");
    assert_eq!(undescribed, None, "every setting says what it is");
}

/// The schema allows of each key exactly the kinds of values that the daemon reads.
fn shapes<D: Settings>() {
    let schema = schema::<D>();
    let allows = |shape: &Value, value: &str| -> bool {
        let one = |shape: &Value| match shape["type"].as_str() {
            Some("string") => value.starts_with('"'),
            Some("number") => value.parse::<f64>().is_ok(),
            Some("integer") => value.parse::<u64>().is_ok(),
            Some("boolean") => ["true", "false"].contains(&value),
            Some("array") => value.starts_with('['),
            Some("object") => value.starts_with('{'),
            other => panic!("{other:?}"),
        };
        match (&shape["enum"], &shape["anyOf"]) {
            (Value::Array(words), _) => words
                .iter()
                .any(|word| word.as_str() == Some(value.trim_matches('"'))),
            (_, Value::Array(any)) => any.iter().any(one),
            _ => one(shape),
        }
    };
    for setting in D::sheet().settings {
        let path: Vec<_> = setting.key.split('.').collect();
        let shape = path.iter().fold(&schema, |at, key| &at["properties"][*key]);
        assert!(
            shape["description"].as_str().is_some_and(|d| d.len() > 10),
            "{}",
            setting.key
        );
        for value in [
            setting.example,
            "\"€\"",
            "-1",
            "0.5",
            "true",
            "[]",
            "{}",
            "[\"€\"]",
        ] {
            let table: toml::Table = in_file(setting.key, value).parse().unwrap();
            let read = D::default().over(table).is_ok();
            // What only reading shows (an address, a file's name) no schema tells.
            let may = allows(shape, value);
            let example = value == setting.example;
            assert!(
                may || !read,
                "{} = {value} is read, and not allowed",
                setting.key
            );
            assert!(!example || (may && read), "{} = {value}", setting.key);
        }
    }
    assert_eq!(schema["additionalProperties"], false);
}

#[test]
fn the_printed_configuration_and_its_schema_are_what_the_daemons_read() {
    examples::<Robot>();
    examples::<Operator>();
    shapes::<Robot>();
    shapes::<Operator>();
}

fn telemime(args: &[&str], environment: &[(&str, &str)]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_telemime"))
        .args(args)
        .envs(environment.iter().copied())
        .output()
        .unwrap()
}

fn said(out: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    (text(&out.stdout), text(&out.stderr))
}

#[test]
fn a_configuration_is_checked_line_by_line_and_explained() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("robot.toml");
    let file = path.to_str().unwrap();
    let check = |text: &str, more: &[&str], environment: &[(&str, &str)]| {
        std::fs::write(&path, text).unwrap();
        let out = telemime(
            &[&["check-config", "robot", file], more].concat(),
            environment,
        );
        (out.status.code(), said(&out))
    };
    let (code, (out, _)) = check("bandwidth_rad_s = 30\n", &[], &[]);
    assert!(code == Some(0) && out.contains("ok"), "{out}");

    for (text, line, words) in [
        ("\nlisten = \n", 2, "no TOML"),
        (
            "name = \"a\"\nbandwith_rad_s = 30\n",
            2,
            "did you mean `bandwidth_rad_s`?",
        ),
        ("listen = \"here\"\n", 1, "socket address"),
        ("tip = 3\n", 1, "expected"),
        ("tip = \"tool0\"\ndead_time_s = 0.2\n", 2, "dead_time_s"),
        ("start = [0.0]\ndriver = \"true\"\n", 2, "leave one out"),
        ("bandwidth_rad_s = 4000\n", 1, "too fast"),
    ] {
        let (code, (_, said)) = check(text, &[], &[]);
        assert_eq!(code, Some(2), "{text}: {said}");
        assert!(
            said.contains(&format!("{file}:{line}: ")) && said.contains(words),
            "{text}: {said}"
        );
        let robot = telemime(&["robot", "--config", file], &[]);
        assert_eq!(
            robot.status.code(),
            Some(2),
            "{text}: {:?}",
            self::said(&robot)
        );
    }
    let both = [
        "operator",
        "--console",
        "127.0.0.1:0",
        "--play",
        "wave.skill",
    ];
    let both = telemime(&both, &[]);
    assert_eq!(both.status.code(), Some(2), "{:?}", said(&both));
    // All of it at once, and what only the arm shows.
    let (code, (_, both)) = check("a = 1\nb = 2\n", &[], &[]);
    assert!(code == Some(2) && both.lines().count() == 2, "{both}");
    let (code, (_, arm)) = check("start = [0.0, 0.0]\n", &[], &[]);
    assert!(code == Some(2) && arm.contains("start posture"), "{arm}");

    let environment = [
        ("TELEMIME_ROBOT_NAME", "by-variable"),
        ("TELEMIME_ROBOT_TIP", "tool"),
    ];
    let flags = ["--explain", "--json", "--", "--tip", "tcp"];
    let (code, (out, _)) = check(
        "name = \"by-file\"\nbandwidth_rad_s = 30\n",
        &flags,
        &environment,
    );
    assert_eq!(code, Some(0), "{out}");
    let told: Value = serde_json::from_str(&out).unwrap();
    let origin = |key: &str| {
        let all = told["settings"].as_array().unwrap();
        let one = all.iter().find(|s| s["key"] == key).unwrap();
        (
            one["value"].as_str().unwrap().to_owned(),
            one["origin"].as_str().unwrap().to_owned(),
        )
    };
    let pair = |a: &str, b: &str| (a.to_owned(), b.to_owned());
    assert_eq!(origin("tip"), pair("tcp", "flag"));
    assert_eq!(origin("name"), pair("\"by-variable\"", "environment"));
    assert_eq!(origin("bandwidth_rad_s"), pair("30", "file"));
    assert_eq!(origin("dead_time_s"), pair("0.0", "default"));
}

#[test]
fn completions_and_man_pages_know_every_command() {
    let commands = telemime(&["--help"], &[]);
    let (help, _) = said(&commands);
    let list = help
        .split("Commands:")
        .nth(1)
        .unwrap()
        .split("Options:")
        .next()
        .unwrap();
    let names: Vec<_> = list
        .lines()
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .collect();
    assert!(names.len() > 20, "{names:?}");
    for shell in ["bash", "zsh", "fish"] {
        let (script, _) = said(&telemime(&["completions", shell], &[]));
        for name in &names {
            assert!(script.contains(name), "{shell}: {name}");
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let out = telemime(&["man", dir.path().to_str().unwrap()], &[]);
    assert!(out.status.success());
    for name in &names {
        let page = std::fs::read_to_string(dir.path().join(format!("telemime-{name}.1"))).unwrap();
        assert!(page.contains(".SH SYNOPSIS"), "{name}");
    }
    let page = std::fs::read_to_string(dir.path().join("telemime-robot.1")).unwrap();
    assert!(page.contains("driver\\-patience"), "{page}");
}

#[test]
fn doctor_says_what_to_do_and_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let home = [("XDG_CONFIG_HOME", dir.path().to_str().unwrap())];
    let out = telemime(&["doctor", "--json"], &home);
    let report: Value = serde_json::from_slice(&out.stdout).unwrap();
    let findings = report["findings"].as_array().unwrap();
    assert!(findings.len() >= 8, "{report}");
    for finding in findings {
        assert_eq!(
            finding["verdict"] == "ok",
            finding["remedy"].is_null(),
            "{finding}"
        );
    }
    assert_eq!(out.status.success(), report["ok"] == true);
    assert_eq!(
        std::fs::read_dir(dir.path()).unwrap().count(),
        0,
        "nothing is written"
    );
}
