use super::*;

fn lines(rows: &[&str]) -> Result<Demonstration, DemonstrationError> {
    Demonstration::parse("skill/take.csv", rows.join("\n").as_bytes())
}

fn good(header: &str, row: impl Fn(usize) -> String) -> Vec<String> {
    let mut all = vec![header.to_owned()];
    all.extend((0..10).map(row));
    all
}

fn with(line: usize, text: &str) -> Result<Demonstration, DemonstrationError> {
    let mut rows = good("t,x,y,z", |i| format!("{},{},2,3", i as f64 * 0.1, i));
    rows[line - 1] = text.to_owned();
    lines(&rows.iter().map(String::as_str).collect::<Vec<_>>())
}

#[test]
fn columns_may_come_in_any_order_with_others_between() {
    let rows = good("weather, z,t,x,note,y", |i| {
        format!("1,3,{},{i},hi,2", i as f64 * 0.1)
    });
    let d = lines(&rows.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
    assert_eq!(d.samples()[4].position, Vector3::new(4.0, 2.0, 3.0));
    assert_eq!(d.name(), "take");
    assert_eq!(
        d.notices()[0].to_string(),
        "skill/take.csv: columns weather, note ignored"
    );
}

#[test]
fn every_fault_names_file_line_and_remedy() {
    let cases = [
        (with(1, "t,x,y"), "skill/take.csv, line 1: no column \"z\""),
        (
            with(1, "t,x,y,z,z"),
            "skill/take.csv, line 1: second column \"z\"",
        ),
        (with(4, "0.2,nan,2,3"), "skill/take.csv, line 4: x is NaN"),
        (with(4, "0.2,1,2,inf"), "skill/take.csv, line 4: z is inf"),
        (with(4, "0.2,1,2,1e300"), "skill/take.csv, line 4: z is 1"),
        (
            with(5, "0.2,1,2,3"),
            "skill/take.csv, line 5: t = 0.2 s is not after the previous 0.2 s",
        ),
        (
            with(5, "0.1,1,2,3"),
            "skill/take.csv, line 5: t = 0.1 s is not after",
        ),
        (
            with(6, "0.4,1,2"),
            "skill/take.csv, line 6: 3 fields where the header has 4",
        ),
        (
            with(6, "0.4,1,2,three"),
            "skill/take.csv, line 6: z is \"three\", not a number",
        ),
        (
            with(6, "0.4,1,,3"),
            "skill/take.csv, line 6: y is \"\", not a number",
        ),
        (lines(&[]), "skill/take.csv: no samples"),
        (lines(&["t,x,y,z"]), "skill/take.csv: no samples"),
        (
            lines(&["t,x,y,z", "0,1,2,3"]),
            "skill/take.csv: 1 samples, at least 8",
        ),
    ];
    for (result, expected) in cases {
        let message = result.unwrap_err().to_string();
        assert!(
            message.starts_with(expected),
            "{message:?} for {expected:?}"
        );
        assert!(message.contains("; "), "no remedy in {message:?}");
    }
    let binary = Demonstration::parse("a.csv", b"t,x,y,z\n\xff\xfe,1,2,3\n").unwrap_err();
    assert!(
        binary.to_string().starts_with("a.csv, line 2: not UTF-8"),
        "{binary}"
    );
}

#[test]
fn a_folder_is_a_skill() {
    let root = tempfile::tempdir().unwrap();
    let dir = root.path().join("wave");
    assert!(matches!(
        Demonstrations::read_dir(&dir, None),
        Err(DemonstrationError::Io { .. })
    ));
    fs::create_dir(&dir).unwrap();
    fs::write(dir.join("readme.txt"), "not a demonstration").unwrap();
    assert!(matches!(
        Demonstrations::read_dir(&dir, None),
        Err(DemonstrationError::NoDemonstrations { .. })
    ));
    let text = good("t,x,y,z", |i| format!("{i},1,2,3")).join("\n");
    fs::write(dir.join("b.csv"), &text).unwrap();
    fs::write(dir.join("a.csv"), &text).unwrap();
    let skill = Demonstrations::read_dir(&dir, None).unwrap();
    assert_eq!(skill.name, "wave");
    let names: Vec<_> = skill
        .demonstrations
        .iter()
        .map(Demonstration::name)
        .collect();
    assert_eq!(names, ["a", "b"]);
    assert_eq!(
        skill.demonstrations[0].sha256(),
        skill.demonstrations[1].sha256()
    );

    let wider = good("t,x,y,z,grip", |i| format!("{i},1,2,3,1")).join("\n");
    fs::write(dir.join("c.csv"), wider).unwrap();
    assert!(matches!(
        Demonstrations::read_dir(&dir, None),
        Err(DemonstrationError::Shape { .. })
    ));
}

#[test]
fn samples_survive_their_csv_to_the_bit() {
    let samples: Vec<Sample> = (0..9)
        .map(|i| {
            Sample::at(
                f64::from(i) / 30.0,
                Vector3::new(0.1, -1.0 / 3.0, 1e-9 * f64::from(i)),
            )
        })
        .collect();
    let d = Demonstration::from_samples("made", &samples).unwrap();
    assert_eq!(d.samples(), samples);
    let again = Demonstration::parse("made", d.to_csv().as_bytes()).unwrap();
    assert_eq!(again, d);
}

#[test]
fn positions_between_samples_are_linear_and_held_outside() {
    let d = with(2, "0,0,2,3").unwrap();
    assert_eq!(d.position_at(-1.0).x, 0.0);
    assert!((d.position_at(0.25).x - 2.5).abs() < 1e-12);
    assert_eq!(d.position_at(0.9).x, 9.0);
    assert_eq!(d.position_at(5.0).x, 9.0);
}

proptest::proptest! {
    #[test]
    fn no_text_makes_the_reader_panic(text in "(t,x,y,z\n)?[0-9.,e\"\n#tnai -]{0,200}", bytes: Vec<u8>) {
        let _ = Demonstration::parse("a.csv", text.as_bytes());
        let _ = Demonstration::parse("a.csv", &bytes);
    }
}

#[test]
fn a_pattern_picks_files_by_name() {
    let matching = |pattern: &str, name: &str| super::matches(pattern, name);
    assert!(matching("a3_s2_*", "a3_s2_t1") && !matching("a3_s2_*", "a3_s21_t1"));
    assert!(matching("*", "") && matching("*t1", "a3_s2_t1") && matching("a*s2*", "a3_s2_t1"));
    assert!(!matching("a", "ab") && !matching("*x*", "abc"));
}

#[test]
fn times_count_from_the_first_sample_whatever_the_clock() {
    let rows: String = (0..10)
        .map(|i| format!("{}.5,0.{i},0,1\n", 1_700_000_000 + i))
        .collect();
    let read = Demonstration::parse("unix.csv", format!("t,x,y,z\n{rows}").as_bytes()).unwrap();
    assert_eq!((read.samples()[0].t_s, read.last().t_s), (0.0, 9.0));
}

fn posed(line: usize, text: &str) -> Result<Demonstration, DemonstrationError> {
    let mut rows = good("t,x,y,z,qw,qx,qy,qz,grip", |i| {
        // Written with the other sign at every second sample.
        let (half, sign) = (0.05 * i as f64, if i % 2 == 0 { 1.0 } else { -1.0 });
        let (w, z) = (sign * half.cos(), sign * half.sin());
        format!(
            "{},1,2,3,{w:.4},0,0,{z:.4},{}",
            i as f64 * 0.1,
            0.1 * i as f64
        )
    });
    rows[line - 1] = text.to_owned();
    lines(&rows.iter().map(String::as_str).collect::<Vec<_>>())
}

#[test]
fn orientation_and_gripper_are_read_interpolated_and_written() {
    let header = "t,x,y,z,qw,qx,qy,qz,grip";
    let d = posed(1, header).unwrap();
    assert!(d.has_orientation() && d.has_grip() && d.notices().is_empty());
    for pair in d.samples().windows(2) {
        let (a, b) = (pair[0].orientation.unwrap(), pair[1].orientation.unwrap());
        assert!(a.coords.dot(&b.coords) > 0.99, "{a} {b}");
    }
    let between = d.orientation_at(0.25).unwrap();
    assert!((between.scaled_axis() - Vector3::z() * 0.25).norm() < 2e-4);
    assert!((d.grip_at(0.25).unwrap() - 0.25).abs() < 1e-12);
    assert!(d.orientation_at(99.0).unwrap().angle() > 0.89);
    let again = Demonstration::parse("again.csv", d.to_csv().as_bytes()).unwrap();
    for (a, b) in d.samples().iter().zip(again.samples()) {
        assert_eq!((a.position, a.grip), (b.position, b.grip));
        assert!(a.orientation.unwrap().angle_to(&b.orientation.unwrap()) < 1e-15);
    }
    let without = good("t,x,y,z", |i| format!("{},{i},2,3", i as f64 * 0.1));
    let without = lines(&without.iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
    assert!(!without.has_orientation() && !without.has_grip());
    assert_eq!(
        (without.orientation_at(0.1), without.grip_at(0.1)),
        (None, None)
    );
}

#[test]
fn a_faulty_orientation_or_gripper_is_refused() {
    let refused = |line, text| posed(line, text).unwrap_err().to_string();
    let says = |text: String, words: &str| assert!(text.contains(words), "{text}");
    says(refused(1, "t,x,y,z,qw,qx,qy,a,grip"), "no column \"qz\"");
    says(
        refused(4, "0.2,1,2,3,1,0,0.5,0,1"),
        "line 4: qw,qx,qy,qz have norm 1.1",
    );
    says(refused(4, "0.2,1,2,3,0,0,0,0,1"), "norm 0");
    says(refused(4, "0.2,1,2,3,nan,0,0,0,1"), "norm NaN");
    says(refused(4, "0.2,1,2,3,1,0,0,0,1.5"), "line 4: grip is 1.5");
    says(refused(4, "0.2,1,2,3,1,0,0,0,nan"), "line 4: grip is NaN");
}

#[test]
fn frames_are_read_kept_and_no_part_of_the_motion() {
    let take = |frames: &[&str]| {
        let mut rows = frames.iter().map(|f| (*f).to_owned()).collect::<Vec<_>>();
        rows.extend(good("t,x,y,z", |i| format!("{},{},2,3", i as f64 * 0.1, i)));
        lines(&rows.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let plain = take(&["# any remark", "#framed, not a frame"]).unwrap();
    assert!(plain.frames().is_empty());
    let d = take(&[
        "# frame cup 0.5 -0.1 2",
        "#frame lid 1 2 3 0.7071068 0 0 0.7071068",
    ])
    .unwrap();
    assert_eq!(d.samples(), plain.samples());
    let [(cup, at), (lid, turned)] = d.frames() else {
        panic!("{:?}", d.frames());
    };
    assert_eq!((cup.as_str(), lid.as_str()), ("cup", "lid"));
    assert_eq!(at.origin, Vector3::new(0.5, -0.1, 2.0));
    assert!((turned.turn * Vector3::x() - Vector3::y()).norm() < 1e-6);
    let again = Demonstration::parse("skill/take.csv", d.to_csv().as_bytes()).unwrap();
    assert_eq!(again.frames()[0], d.frames()[0]);
    assert!((again.frames()[1].1.turn.coords - turned.turn.coords).norm() < 1e-15);

    for (bad, why) in [
        ("# frame", "line 2: the name is missing"),
        ("# frame cup 1 2", "line 2: 2 numbers, where three"),
        (
            "# frame cup 1 2 z",
            "line 2: \"z\" is not a number; write `# frame NAME",
        ),
        ("# frame cup 1 2 inf", "line 2: a number is not finite"),
        ("# frame cup 1 2 3 1 1 0 0", "have norm 1.4142"),
        ("# frame hat 1 2 3", "\"hat\" is placed a second time"),
    ] {
        let error = take(&["# frame hat 0 0 0", bad]).unwrap_err().to_string();
        assert!(
            error.contains(why) && error.contains("skill/take.csv, line 2"),
            "{bad}: {error}"
        );
    }
}
