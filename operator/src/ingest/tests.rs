use super::*;

/// A slow circle in the horizontal plane, 30 Hz.
fn circle(n: usize) -> Vec<(f64, [f64; 3])> {
    let at = |i: usize| {
        let t = i as f64 / 30.0;
        (t, [0.3 * t.cos(), 1.0, 0.3 * t.sin()])
    };
    (0..n).map(at).collect()
}

fn table(rows: &[(f64, [f64; 3])]) -> String {
    let line = |(t, [x, y, z]): &(f64, [f64; 3])| format!("{t},{x},{y},{z}\n");
    "t,x,y,z\n".to_owned() + &rows.iter().map(line).collect::<String>()
}

fn with(text: &str, options: &Options) -> Result<Imported, Fault> {
    let imported = import(text.as_bytes(), options)?;
    assert_eq!(imported.report.accounted(), imported.report.frames);
    for take in &imported.takes {
        assert!(take.samples.len() >= LEAST_SAMPLES);
        assert!(take.samples.windows(2).all(|w| w[0].t_s < w[1].t_s));
    }
    Ok(imported)
}

fn plain(text: &str) -> Result<Imported, Fault> {
    with(text, &Options::default())
}

#[test]
fn a_long_hole_splits_and_a_short_one_does_not() {
    let mut rows = circle(90);
    rows.iter_mut().skip(30).for_each(|r| r.0 += 0.4);
    rows.iter_mut().skip(60).for_each(|r| r.0 += 40.0);
    let imported = plain(&table(&rows)).unwrap();
    assert_eq!(imported.takes.len(), 2);
    assert_eq!(imported.takes[0].samples.len(), 60);
    let [(from, to)] = imported.report.holes_s[..] else {
        panic!("{:?}", imported.report.holes_s);
    };
    assert!(to - from > 40.0);
    // Each demonstration begins at 0.
    let text = imported.takes[1].to_csv();
    assert!(text.lines().nth(1).unwrap().starts_with("0,"), "{text}");
}

#[test]
fn what_is_too_short_is_left_out_and_counted_unless_nothing_else_is_there() {
    let mut rows = circle(65);
    rows.iter_mut().skip(60).for_each(|r| r.0 += 2.0);
    let report = plain(&table(&rows)).unwrap().report;
    assert_eq!((report.takes.len(), report.too_short), (1, 5));
    let fault = plain(&table(&circle(7))).unwrap_err();
    assert!(
        matches!(
            fault,
            Fault::NothingUsable {
                frames: 7,
                longest: 7,
                ..
            }
        ),
        "{fault}"
    );
}

#[test]
fn reordered_samples_are_sorted_and_a_clock_set_back_is_refused() {
    let mut rows = circle(60);
    let sorted = plain(&table(&rows)).unwrap();
    rows.swap(20, 21);
    rows.swap(40, 43);
    let put_right = plain(&table(&rows)).unwrap();
    assert_eq!(put_right.takes, sorted.takes);
    assert_eq!(put_right.report.reordered, 4);
    let twice = [circle(60), circle(60)].concat();
    let fault = plain(&table(&twice)).unwrap_err();
    assert!(
        matches!(fault, Fault::Backwards { line: 62, .. }),
        "{fault}"
    );
}

#[test]
fn samples_of_one_time_become_one() {
    let mut rows = circle(30);
    rows.insert(11, rows[10]);
    let mut other = rows[20];
    other.1[0] += 0.02;
    rows.insert(21, other);
    let imported = plain(&table(&rows)).unwrap();
    assert_eq!((imported.report.repeated, imported.report.merged), (1, 1));
    assert_eq!(imported.takes[0].samples.len(), 30);
    let middle = imported.takes[0].samples[19].position.x;
    assert!((middle - rows[20].1[0] - 0.01).abs() < 1e-12);
}

/// Frames of an SDK skeleton whose right hand goes round; `state` of each.
fn kinect(
    times: impl Fn(usize) -> String,
    separator: &str,
    state: impl Fn(usize) -> &'static str,
) -> String {
    let mut text = String::new();
    for (i, (_, hand)) in circle(40).into_iter().enumerate() {
        let mut fields = vec![times(i)];
        for joint in 0..20 {
            let place = if joint == 11 {
                hand
            } else {
                [0.0, f64::from(joint), 2.0]
            };
            fields.extend(place.iter().map(f64::to_string));
            fields.push(if joint == 11 {
                state(i).to_owned()
            } else {
                "2".to_owned()
            });
        }
        text += &(fields.join(separator) + "\n");
    }
    text
}

#[test]
fn sdk_skeletons_in_any_unit_of_time() {
    let ms = |i: usize| (1_500_000_000_000 + 1000 * i as u64 / 30).to_string();
    let us = |i: usize| (1_000_000 * i as u64 / 30).to_string();
    for (text, unit) in [
        (kinect(ms, ",", |_| "2"), TimeUnit::Ms),
        (kinect(us, " ", |_| "Tracked"), TimeUnit::Us),
        (kinect(us, "; ", |_| "2"), TimeUnit::Us),
    ] {
        let imported = plain(&text).unwrap();
        assert_eq!(imported.report.format, Format::Kinect);
        assert_eq!(imported.report.time_unit, Some(unit));
        let samples = &imported.takes[0].samples;
        for (sample, (t, hand)) in samples.iter().zip(circle(40)) {
            assert!((sample.t_s - t).abs() < 1.1e-3);
            assert_eq!(sample.position, Vector3::from(hand));
        }
        assert_eq!(samples.len(), 40);
    }
    let left = Options {
        joint: "left_hand".to_owned(),
        ..Options::default()
    };
    let still = with(&kinect(ms, ",", |_| "2"), &left).unwrap();
    assert_eq!(still.takes[0].samples[3].position.y, 7.0);
}

#[test]
fn frames_without_the_hand_are_holes() {
    let lost = |i: usize| match i {
        10..12 => "0",
        20..25 => "Inferred",
        _ => "2",
    };
    let ms = |i: usize| (1000 * i / 30).to_string();
    let report = plain(&kinect(ms, ",", lost)).unwrap().report;
    assert_eq!(
        (report.untracked, report.inferred, report.takes.len()),
        (2, 5, 1)
    );
    let long = |i: usize| if (10..30).contains(&i) { "0" } else { "2" };
    let report = plain(&kinect(ms, ",", long)).unwrap().report;
    assert_eq!((report.untracked, report.takes.len()), (20, 2));
    let fault = plain(&kinect(ms, ",", |_| "3")).unwrap_err();
    assert!(matches!(fault, Fault::State { line: 1, .. }), "{fault}");
}

#[test]
fn poses_come_along_with_unit_length_and_a_steady_sign() {
    let mut text = String::from("\u{feff}stamp;x;y;z;qw;qx;qy;qz;grip;note\n# remark\n");
    for i in 0..30 {
        let angle = 0.05 * f64::from(i);
        let k = if i % 2 == 0 { 1.0 } else { -1.01 };
        let (w, z) = (k * angle.cos(), k * angle.sin());
        text += &format!(
            "{};{};0,5;0;{w};0;0;{z};0.25;a\n",
            33_333 * i,
            0.01 * f64::from(i)
        );
    }
    let columns = "t=stamp,x=x,y=y,z=3,qw=qw,qx=qx,qy=qy,qz=qz,grip=grip";
    let options = Options {
        columns: columns.replace("z=3", "z=4").parse().unwrap(),
        ..Options::default()
    };
    let imported = with(&text, &options).unwrap();
    let report = &imported.report;
    assert_eq!(
        (report.flipped, report.normalised, report.orientation),
        (15, 15, true)
    );
    for (i, sample) in imported.takes[0].samples.iter().enumerate() {
        let [w, _, _, z] = sample.orientation.unwrap();
        let angle = 0.05 * i as f64;
        assert!((w - angle.cos()).abs() < 1e-12 && (z - angle.sin()).abs() < 1e-12);
        assert_eq!((sample.position.y, sample.grip), (0.5, Some(0.25)));
    }
    let csv = imported.takes[0].to_csv();
    assert!(
        csv.starts_with("t,x,y,z,qw,qx,qy,qz,grip\n0,0,0.5,0,1,0,0,0,0.25\n"),
        "{csv}"
    );
    let read = crate::demonstration::Demonstration::parse("pose.csv", csv.as_bytes()).unwrap();
    assert_eq!(read.samples().len(), 30);

    let shut = Options {
        grip_range: (0.5, 0.0),
        ..options.clone()
    };
    let half = with(&text, &shut).unwrap();
    assert_eq!(half.takes[0].samples[3].grip, Some(0.5));
    let narrow = Options {
        grip_range: (0.0, 0.2),
        ..options
    };
    let fault = with(&text, &narrow).unwrap_err();
    assert!(matches!(fault, Fault::Grip { line: 3, .. }), "{fault}");
}

#[test]
fn a_table_needs_its_columns_named_or_a_header() {
    let rows: String = (0..20)
        .map(|i| format!("{i} {} 0 0\n", 0.01 * f64::from(i)))
        .collect();
    let numbered = |text: &str| Options {
        columns: text.parse().unwrap(),
        ..Options::default()
    };
    // No times: a frame rate is needed.
    let fault = with(&rows, &numbered("x=2,y=3,z=4")).unwrap_err();
    assert!(matches!(fault, Fault::NoTime), "{fault}");
    let options = Options {
        fps: Some(50.0),
        ..numbered("x=2,y=3,z=4")
    };
    let imported = with(&rows, &options).unwrap();
    assert!((imported.takes[0].samples[19].t_s - 0.38).abs() < 1e-12);
    // A step of one is a millisecond, or one second if one says so: then every step is a hole.
    assert_eq!(plain(&rows).unwrap().report.time_unit, Some(TimeUnit::Ms));
    let seconds = Options {
        time: Some(TimeUnit::S),
        ..Options::default()
    };
    assert!(matches!(
        with(&rows, &seconds),
        Err(Fault::NothingUsable { longest: 1, .. })
    ));
    let fault = with(&rows, &numbered("t=1,x=2,y=3,z=7")).unwrap_err();
    assert!(
        matches!(
            fault,
            Fault::Column {
                what: "z",
                twice: false,
                ..
            }
        ),
        "{fault}"
    );
}

#[test]
fn numbers_that_are_none_are_refused_and_missing_ones_are_holes() {
    let rows = table(&circle(40));
    let line = rows.lines().nth(12).unwrap();
    let (t, rest) = line.split_once(',').unwrap();
    let fault = plain(&rows.replace(line, &format!("nan,{rest}"))).unwrap_err();
    assert!(
        matches!(fault, Fault::NotFinite { line: 13, .. }),
        "{fault}"
    );
    let fault = plain(&rows.replace(line, &format!("{t},inf,0,0"))).unwrap_err();
    assert!(
        matches!(fault, Fault::NotFinite { line: 13, .. }),
        "{fault}"
    );
    let report = plain(&rows.replace(line, &format!("{t},nan,0,")))
        .unwrap()
        .report;
    assert_eq!((report.untracked, report.takes[0].samples), (1, 39));
    let fault = plain(&rows.replace(line, "1,2")).unwrap_err();
    assert!(
        matches!(
            fault,
            Fault::Fields {
                line: 13,
                found: 2,
                ..
            }
        ),
        "{fault}"
    );
    let fault = import(b"t,x,y,z\n0,1,2,3\n\xff", &Options::default()).unwrap_err();
    assert!(matches!(fault, Fault::NotText { line: 3 }), "{fault}");
}

#[test]
fn smoothing_is_asked_for_and_told() {
    let mut rows = circle(90);
    rows.iter_mut()
        .enumerate()
        .for_each(|(i, r)| r.1[1] += if i % 2 == 0 { 0.004 } else { -0.004 });
    let options = Options {
        smooth_hz: Some(3.0),
        ..Options::default()
    };
    let imported = with(&table(&rows), &options).unwrap();
    let (hz, moved_m) = imported.report.smoothed.unwrap();
    assert!(hz == 3.0 && (0.003..0.012).contains(&moved_m), "{moved_m}");
    let calm = imported.takes[0].samples[10..80].iter();
    assert!(calm.clone().all(|s| (s.position.y - 1.0).abs() < 2e-4));
    // The circle is where it was.
    for (s, (_, [x, _, z])) in calm.zip(&circle(90)[10..]) {
        assert!((s.position.x - x).hypot(s.position.z - z) < 2e-3);
    }
}

#[test]
fn cuts_by_hand_must_fall_into_the_recording_and_leave_enough() {
    let rows = table(&circle(60));
    let at = |times: &[f64]| Options {
        cut: Cut::At(times.to_vec()),
        ..Options::default()
    };
    let imported = with(&rows, &at(&[1.0])).unwrap();
    assert_eq!(
        imported.takes[0].samples.len() + imported.takes[1].samples.len(),
        60
    );
    assert!(matches!(
        with(&rows, &at(&[7.0])),
        Err(Fault::CutOutside { .. })
    ));
    assert!(matches!(
        with(&rows, &at(&[0.1])),
        Err(Fault::CutShort { found: 3..=4, .. })
    ));
}

#[test]
fn any_bytes_end_in_a_result() {
    use proptest::prelude::*;
    let words = [
        "1",
        "-2.5",
        "nan",
        "1e300",
        ",",
        ";",
        " ",
        "\t",
        "\n",
        "t,x,y,z\n",
        "#",
        "\"",
        "0",
        "33",
    ];
    let soup = proptest::collection::vec(proptest::sample::select(words.to_vec()), 0..400);
    proptest!(|(soup in soup, cut in any::<bool>())| {
        let cut = if cut { Cut::Repetitions } else { Cut::Whole };
        let options = Options { cut, smooth_hz: Some(4.0), fps: Some(30.0), ..Options::default() };
        if let Ok(imported) = import(soup.concat().as_bytes(), &options) {
            prop_assert_eq!(imported.report.accounted(), imported.report.frames);
        }
    });
}

#[test]
fn three_named_columns_are_a_table_and_no_skeleton() {
    let rows: String = (0..45).map(|i| format!("{i},1,2\n")).collect();
    // As many lines as three frames of 15 joints have.
    let told = plain(&format!("t,x,y\n{rows}")).unwrap_err().to_string();
    assert!(told.contains("no column \"z\""), "{told}");
    let told = plain(&format!("x,y,z\n{rows}")).unwrap_err();
    assert!(matches!(told, Fault::NoTime), "{told}");
}
