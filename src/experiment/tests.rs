use std::path::Path;

use super::*;

/// One person who learned from two performances, everybody who follows, one of the runs without a link.
const PLAN: &str = "\
title = \"A & B\"
seed = 3
[motion]
people = 1
performances = 2
[factors]
method = [\"ours\", \"hold\", \"kalman\", \"playback\", \"floor\"]
link = [\"delay 40ms 4ms loss 2%\", \"delay 80ms 8ms loss 2%\"]
[[case]]
[[case]]
motion = \"on-model\"
method = \"ours\"
outage = \"2s..9s\"
";

fn args(plan: &Path, out: &Path, shard: &str, threads: u16) -> Args {
    Args {
        what: None,
        plan: Some(plan.display().to_string()),
        out: Some(out.to_owned()),
        shard: shard.parse().unwrap(),
        threads: Some(threads),
        ground: Ground::Virtual,
        seeds: None,
        people: None,
        dry_run: false,
        list: false,
        print: None,
        json: false,
    }
}

/// Every file but the timing, by name.
fn bytes(dir: &Path) -> Vec<(String, Vec<u8>)> {
    let mut all = Vec::new();
    for folder in [dir.to_owned(), dir.join("series")] {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(dir).unwrap().display().to_string();
            if path.is_file() && name != "timing.json" {
                all.push((name, std::fs::read(path).unwrap()));
            }
        }
    }
    all.sort();
    all
}

#[test]
fn the_same_plan_gives_the_same_bytes_on_any_number_of_threads_in_parts_and_interrupted() {
    let scratch = tempfile::tempdir().unwrap();
    let at = |name: &str| scratch.path().join(name);
    let plan = at("plan.toml");
    std::fs::write(&plan, PLAN).unwrap();
    run(&args(&plan, &at("once"), "1/1", 2)).unwrap();
    let once = bytes(&at("once"));
    let names: Vec<&str> = once.iter().map(|(name, _)| name.as_str()).collect();
    assert!(
        names.contains(&"results.csv") && names.contains(&"manifest.json"),
        "{names:?}"
    );
    assert!(!names.contains(&"part.csv"), "{names:?}");

    // Again, in two parts.
    for part in ["1/2", "2/2"] {
        run(&args(&plan, &at(&part.replace('/', "-")), part, 1)).unwrap();
    }
    let dirs = [at("1-2"), at("2-2")];
    store::merge(&at("merged"), &dirs).unwrap();
    assert!(bytes(&at("merged")) == once, "merged, it is another result");
    let missing = store::merge(&at("half"), &dirs[..1]).unwrap_err();
    assert!(missing.to_string().contains("is in none"), "{missing}");

    // Interrupted while the third run was being written.
    let results = std::fs::read_to_string(at("once").join(store::RESULTS)).unwrap();
    let lines: Vec<&str> = results.split_inclusive('\n').collect();
    std::fs::create_dir_all(at("cut")).unwrap();
    for name in [store::MANIFEST, store::PLAN] {
        std::fs::copy(at("once").join(name), at("cut").join(name)).unwrap();
    }
    let third = &lines[3][..lines[3].len() / 2];
    let part = [lines[1], lines[2], third].concat();
    std::fs::write(at("cut").join("part.csv"), &part).unwrap();
    std::fs::create_dir_all(at("cut").join("series")).unwrap();
    run(&args(&plan, &at("cut"), "1/1", 2)).unwrap();
    assert!(
        bytes(&at("cut")) == once,
        "gone on with, it is another result"
    );

    // A line that is none is not gone on with, and another plan overwrites nothing.
    std::fs::remove_file(at("cut").join(store::RESULTS)).unwrap();
    std::fs::write(at("cut").join("part.csv"), [lines[1], "1,2,3\n"].concat()).unwrap();
    let refused = run(&args(&plan, &at("cut"), "1/1", 1)).unwrap_err();
    assert!(
        refused.to_string().contains("part.csv:2: not a result"),
        "{refused}"
    );
    let other = at("other.toml");
    std::fs::write(&other, PLAN.replace("seed = 3", "seed = 4")).unwrap();
    let refused = run(&args(&other, &at("once"), "1/1", 1)).unwrap_err();
    assert!(refused.to_string().contains("another plan"), "{refused}");

    // Results that were cut, and courses, are no results.
    let results = at("once").join(store::RESULTS);
    let text = std::fs::read_to_string(&results).unwrap();
    let cut = |text: &str| {
        std::fs::write(&results, text).unwrap();
        store::read(&at("once"))
            .map(|_| ())
            .unwrap_err()
            .to_string()
    };
    let last = text.trim_end().rfind('\n').unwrap() + 1;
    assert!(cut(&text[..last]).contains("is not there"));
    assert!(cut(&[&text, &text[last..]].concat()).contains("there twice"));
    assert!(cut(&text[..text.len() - 30]).contains("results.csv:"));
    std::fs::write(&results, &text).unwrap();
    let mut courses = std::fs::read_dir(at("once").join("series")).unwrap();
    let course = courses.next().unwrap().unwrap().path();
    let bytes_of = std::fs::read(&course).unwrap();
    std::fs::write(&course, &bytes_of[..bytes_of.len() / 2]).unwrap();
    let refused = store::read(&at("once"))
        .map(|_| ())
        .unwrap_err()
        .to_string();
    assert!(refused.contains("series"), "{refused}");
    std::fs::write(&course, &bytes_of).unwrap();

    // What was run makes sense: the floor is lowest, holding is not best, and a link that stays away stops the arm.
    let (_, _, rows) = store::read(&at("once")).unwrap();
    let of = |method: &str, up: &str| {
        let fits = |row: &&row::Row| {
            let text = |name| factor::of(&row.texts, name);
            text("method") == method
                && text("motion") == "on-model"
                && (text("up").starts_with(up) || text("up") == factor::UNUSED)
                && text("outage") != "2s..9s"
        };
        rows.iter().find(fits).unwrap().figures
    };
    let rmse = |method, up| of(method, up).rmse_m.unwrap();
    for up in ["delay 40ms", "delay 80ms"] {
        assert!(rmse("floor", up) < rmse("ours", up));
        assert!(rmse("ours", up) < rmse("hold", up));
    }
    assert!(rmse("hold", "delay 40ms") < rmse("hold", "delay 80ms"));
    let held = of("hold", "delay 80ms");
    assert!((held.delay_p50_s.unwrap() - 0.08).abs() < 3e-3);
    let stopped: Vec<_> = rows
        .iter()
        .filter(|r| r.outcome.starts_with("stopped"))
        .collect();
    assert_eq!(stopped.len(), 2);
    // One message may have been on its way; the lease is 0.65 s, and stopping takes a moment.
    assert!(
        stopped
            .iter()
            .all(|r| (0.4..1.6).contains(&r.figures.stop_s.unwrap()))
    );

    // The report, twice.
    let page = |out: &Path| {
        report::write(&at("once"), &out.join("report.html"), Some(out)).unwrap();
        std::fs::read_to_string(out.join("report.html")).unwrap()
    };
    std::fs::create_dir_all(at("a")).unwrap();
    std::fs::create_dir_all(at("b")).unwrap();
    let html = page(&at("a"));
    assert!(html == page(&at("b")), "another page");
    let names = html.replace("http://www.w3.org/2000/svg", "");
    for fetched in ["http:", "https:", "url(", "src=", "@import", "<script"] {
        assert!(!names.contains(fetched), "{fetched}");
    }
    assert!(html.contains("<h1>A &amp; B</h1>") && !html.contains("NaN"));
    assert!(html.contains("<h2>Outages</h2>") && html.contains("<td>1 of 1 run</td>"));
    for chart in [
        "delay-on-model",
        "delay-off-model",
        "lag",
        "age",
        "timeline",
        "calibration",
    ] {
        assert!(
            html.contains(&format!("<figure id=\"{chart}\">")),
            "{chart}"
        );
        for ending in ["svg", "png", "csv"] {
            let path = at("a").join(chart).with_extension(ending);
            assert!(path.exists(), "{}", path.display());
        }
    }
    let unfinished = report::write(&at("cut"), &at("x.html"), None).unwrap_err();
    assert!(
        unfinished.to_string().contains("not finished"),
        "{unfinished}"
    );
}

#[test]
fn a_shard_is_written_as_a_fraction() {
    assert_eq!("2/5".parse(), Ok(Shard { part: 2, of: 5 }));
    for wrong in ["0/3", "4/3", "3", "a/b", "1/0"] {
        assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
    }
}

/// What everybody's packets meet, at the hand's own time: ours after a handshake and three seconds of rest, a baseline after
/// one and none.
#[test]
fn whoever_follows_meets_the_same_link_at_the_same_moment_of_the_hand() {
    let scratch = tempfile::tempdir().unwrap();
    let series = "t_s,delay_ms\n0,10\n1,60\n2,30\n3,20\n";
    std::fs::write(scratch.path().join("series.csv"), series).unwrap();
    let plan = "[motion]\npeople = 1\nperformances = 2\n[factors]\nmotion = \"on-model\"\nmethod = [\"ours\", \"hold\", \"kalman\"]\n\
                link = [\"delay 20ms outage 2s..2.4s every 3s\", \"trace series.csv\"]\ninput_latency = [\"0ms\", \"50ms\"]\n";
    let plan = Plan::parse("moments", plan, scratch.path()).unwrap();
    let subjects = subject::subjects(subject::materials(&plan).unwrap(), plan.seed, || ()).unwrap();
    let rigs = rigs(&plan).unwrap();
    let rig = rigs.values().next().unwrap();
    let mut kinds = std::collections::BTreeSet::new();
    for cell in &plan.cells {
        let (settings, axes) = (&cell.settings, plan.motion.axes);
        let trace = if settings.method == method::Method::Ours {
            drive::drive(settings, &subjects[0], rig, axes, 7).unwrap()
        } else {
            baseline::drive(settings, &subjects[0], rig, axes, 7)
        };
        let packets = trace.packets.unwrap();
        let during: Vec<_> = packets
            .iter()
            .filter(|p| (0.0..9.0).contains(&p.sent_s))
            .collect();
        assert!(during.len() > 50);
        let mut met = [0; 2];
        for p in during {
            let out = (2.0..2.4).contains(&p.sent_s.rem_euclid(3.0)) && p.sent_s >= 2.0;
            let late_s = match settings.up.trace {
                None => (!out).then_some(0.02),
                Some(_) => Some([0.01, 0.06, 0.03, 0.02][p.sent_s as usize % 4]),
            };
            met[usize::from(late_s == Some(0.02) || late_s == Some(0.06))] += 1;
            let right = match (late_s, p.arrived_s) {
                (Some(late_s), Some(at_s)) => (at_s - p.sent_s - late_s).abs() < 1e-6,
                (None, None) => true,
                _ => false,
            };
            // The edge itself is a rounding's.
            let edge = (p.sent_s * 5.0 - (p.sent_s * 5.0).round()).abs() < 1e-6;
            assert!(right || edge, "{} {p:?}", settings.method);
        }
        assert!(met.iter().all(|n| *n > 0), "{met:?}");
        kinds.insert(cell.texts.to_vec());
    }
    assert_eq!(kinds.len(), 12);
}

/// A plan's files are those beside it, wherever it is run and reported from; a plan that somebody keeps where results go stays.
#[test]
fn a_recorded_link_is_the_plans_own_and_has_no_delay_of_its_own() {
    let scratch = tempfile::tempdir().unwrap();
    let at = |name: &str| scratch.path().join(name);
    std::fs::create_dir(at("mine")).unwrap();
    let (plan, out) = (at("mine").join("slow.toml"), at("out"));
    let text = "[motion]\npeople = 1\nperformances = 2\n[factors]\nmotion = \"on-model\"\nmethod = [\"hold\", \"floor\"]\n\
                link = [\"trace phone.csv\", \"delay 100ms\"]\n";
    std::fs::write(&plan, text).unwrap();
    let series = "t_s,delay_ms\n0,40\n1,60\n";
    std::fs::write(at("mine").join("phone.csv"), series).unwrap();
    run(&args(&plan, &out, "1/1", 2)).unwrap();
    let (manifest, _, rows) = store::read(&out).unwrap();
    let known: Vec<_> = manifest.inputs.iter().collect();
    let (name, hash) = known[0];
    assert_eq!((known.len(), name.as_str()), (1, "phone.csv"));
    assert_eq!(*hash, plan::sha256(series));
    assert!(!manifest.is_of_recordings());

    report::write(&out, &at("report.html"), Some(scratch.path())).unwrap();
    let html = std::fs::read_to_string(at("report.html")).unwrap();
    assert!(html.contains("generated hands") && !html.contains("At 0 ms"));
    let held: Vec<f64> = rows.iter().filter_map(|r| r.figures.rmse_m).collect();
    assert_eq!(held.len(), 3);

    std::fs::write(at("mine").join("phone.csv"), "t_s,delay_ms\n0,400\n").unwrap();
    let refused = run(&args(&plan, &out, "1/1", 2)).unwrap_err().to_string();
    assert!(refused.contains("state of the plan's files"), "{refused}");

    let precious = at("mine").join(store::PLAN);
    std::fs::write(&precious, "precious").unwrap();
    let refused = run(&args(&plan, &at("mine"), "1/1", 2)).unwrap_err();
    assert!(
        refused.to_string().contains("is not this plan"),
        "{refused}"
    );
    let refused = store::merge(&at("mine"), std::slice::from_ref(&out)).unwrap_err();
    assert!(
        refused.to_string().contains("is not this plan"),
        "{refused}"
    );
    assert_eq!(std::fs::read_to_string(&precious).unwrap(), "precious");

    std::fs::write(out.join(store::PLAN), text.replace("100ms", "10ms")).unwrap();
    let edited = report::write(&out, &at("x.html"), None).unwrap_err();
    assert!(edited.to_string().contains("is not the plan"), "{edited}");
}
