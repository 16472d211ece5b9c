use std::io::Cursor;
use std::sync::atomic::Ordering;

use nalgebra::Vector3;
use telemime_protocol::time::Stamp;
use telemime_protocol::wire::v1::{Cause, Refusal, RobotState};

use super::read::{channel, lines};
use super::*;
use crate::ingest::{LengthUnit, TimeUnit};
use crate::session::{Event, LOST_S, Session};
use crate::task::tests::ready;

fn parse(line: &str) -> Result<Frame, Kind> {
    frame::parse(line.as_bytes(), &Units::default()).map_err(|fault| fault.kind)
}

fn place(line: &str) -> Vector3<f64> {
    parse(line).unwrap().hand.unwrap().position
}

#[test]
fn points_and_skeletons_are_read_in_the_units_that_were_named() {
    let frame = parse(
        r#"{"t":1.5,"x":1,"y":-2e-1,"z":0.25,"qw":0,"qx":1,"qy":0,"qz":0,"grip":0.5,"engage":true,"id":7}"#,
    );
    let frame = frame.unwrap();
    let hand = frame.hand.unwrap();
    assert_eq!(hand.position, Vector3::new(1.0, -0.2, 0.25));
    assert_eq!(hand.orientation.unwrap().i, 1.0);
    assert_eq!(
        (frame.t_s, hand.grip, frame.engage),
        (Some(1.5), Some(0.5), Some(true))
    );
    for joint in [
        r#"{"right_hand":[1,2,3],"head":null}"#,
        r#"{"HandRight":{"x":1,"y":2,"z":3,"confidence":0.9}}"#,
        r#"{"Right Hand":[1,2,3,1,0,0,0],"left_hand":[9,9,9]}"#,
    ] {
        let at = place(&format!(r#"{{"joints":{joint}}}"#));
        assert_eq!(at, Vector3::new(1.0, 2.0, 3.0), "{joint}");
    }
    let units = Units {
        length: LengthUnit::Mm,
        time: TimeUnit::Ms,
        grip: (80.0, 0.0),
        joint: "palm".into(),
    };
    let line = br#"{"t":1500,"joints":{"palm":[100,0,2000]},"grip":20}"#;
    let frame = frame::parse(line, &units).unwrap();
    let hand = frame.hand.unwrap();
    assert_eq!(hand.position, Vector3::new(0.1, 0.0, 2.0));
    assert_eq!((frame.t_s, hand.grip), (Some(1.5), Some(0.75)));
    // A clutch alone, and one beside a hand that is not seen.
    assert_eq!(parse(r#"{"engage":false}"#).unwrap().engage, Some(false));
    assert_eq!(parse(r#"{"joints":{},"engage":false}"#).unwrap().hand, None);
}

#[test]
fn what_is_no_frame_is_named_by_its_fault() {
    for (line, kind) in [
        ("", Kind::Malformed),
        ("{", Kind::Malformed),
        ("[1,2,3]", Kind::Malformed),
        ("{}", Kind::Malformed),
        (r#"{"x":1,"y":2}"#, Kind::Malformed),
        (r#"{"x":1,"y":2,"z":"3"}"#, Kind::Malformed),
        (r#"{"x":1,"y":2,"z":3,"qw":1}"#, Kind::Malformed),
        (r#"{"joints":{"right_hand":[1,2]}}"#, Kind::Malformed),
        (r#"{"x":1,"y":2,"z":3} {"x":1}"#, Kind::Malformed),
        (r#"{"x":NaN,"y":2,"z":3}"#, Kind::NotFinite),
        (r#"{"x":-Infinity,"y":2,"z":3}"#, Kind::NotFinite),
        (r#"{"x":1e999,"y":2,"z":3}"#, Kind::NotFinite),
        (r#"{"x":1200,"y":2,"z":3}"#, Kind::NotFinite),
        (r#"{"t":1732280000123,"x":1,"y":2,"z":3}"#, Kind::NotFinite),
        (
            r#"{"x":1,"y":2,"z":3,"qw":1,"qx":1,"qy":0,"qz":0}"#,
            Kind::NoRotation,
        ),
        (
            r#"{"x":1,"y":2,"z":3,"qw":0,"qx":0,"qy":0,"qz":0}"#,
            Kind::NoRotation,
        ),
        (r#"{"x":1,"y":2,"z":3,"grip":1.2}"#, Kind::Grip),
        (r#"{"joints":{"left_hand":[1,2,3]}}"#, Kind::Untracked),
        (r#"{"joints":{"right_hand":null}}"#, Kind::Untracked),
    ] {
        assert_eq!(parse(line).unwrap_err(), kind, "{line}");
    }
    let deep = "[".repeat(frame::LONGEST);
    assert_eq!(parse(&deep).unwrap_err(), Kind::Malformed);
    assert_eq!(parse(&format!("{deep} ")).unwrap_err(), Kind::Oversized);
}

#[test]
fn lines_are_taken_one_by_one_and_an_endless_one_costs_only_itself() {
    let long = "x".repeat(10 * frame::LONGEST);
    let fitting = format!("{{\"engage\":true{}}}", " ".repeat(frame::LONGEST - 15));
    assert_eq!(fitting.len(), frame::LONGEST);
    let text = format!("{{\"engage\":true}}\r\n\n{long}\n{fitting}\n{{\"engage\":false}}");
    let (to, mut inlet) = channel(Box::new(|| at(0)));
    lines(Cursor::new(text), &Units::default(), to);
    let said: Vec<_> = std::iter::from_fn(|| inlet.arrived.try_recv().ok())
        .map(|arrived| arrived.what)
        .collect();
    let clutch = |what: &What| match what {
        What::Frame(frame) => frame.engage,
        _ => None,
    };
    assert_eq!(said.len(), 5, "{said:?}");
    assert!(matches!(&said[1], What::Dropped(fault) if fault.kind == Kind::Oversized));
    let held: Vec<_> = [0, 2, 3].map(|i| clutch(&said[i])).into();
    assert_eq!(held, [Some(true), Some(true), Some(false)]);
    assert!(matches!(&said[4], What::End(_)));
}

#[test]
fn a_flood_is_not_even_decoded_and_its_end_is_told() {
    let text = "{\"engage\":true}\n".repeat(1000);
    // All of it at one moment.
    let (to, mut inlet) = channel(Box::new(|| at(0)));
    lines(Cursor::new(text), &Units::default(), to);
    let mut taken = 0;
    let mut end = None;
    while let Ok(arrived) = inlet.arrived.try_recv() {
        match arrived.what {
            What::Frame(_) => taken += 1,
            other => end = Some(other),
        }
    }
    assert_eq!((taken, inlet.overflow.load(Ordering::Relaxed)), (250, 750));
    assert!(matches!(end, Some(What::End(_))), "{end:?}");
    // What the threads did not decode, the driver counts and tells once.
    let mut driver = Driver::new(inlet, Habits::default());
    driver.advise(at(0), &mut ready());
    assert_eq!(driver.tally().of(Kind::Flood), 750);
    assert!(driver.poll_note().unwrap().contains("faster"));
}

fn at(ms: i64) -> Stamp {
    Stamp(ms * 1_000_000)
}

struct Bench {
    driver: Driver,
    session: Session,
    /// Whether frames carry the sender's own times.
    timed: bool,
}

impl Bench {
    fn new(habits: Habits) -> Self {
        let (_, inlet) = channel(Box::new(|| at(0)));
        let mut driver = Driver::new(inlet, habits);
        driver.on_event(at(0), &Event::Ready);
        Self {
            driver,
            session: ready(),
            timed: false,
        }
    }

    fn frame(&mut self, ms: i64, engage: Option<bool>) {
        let x = Vector3::new(1e-4 * ms as f64, 0.0, 2.0);
        let frame = Frame {
            t_s: self.timed.then_some(ms as f64 * 1e-3 + 77.0),
            hand: Some(Place {
                position: x,
                orientation: None,
                grip: None,
            }),
            engage,
        };
        self.put(ms, What::Frame(frame));
    }

    fn put(&mut self, ms: i64, what: What) {
        let arrived = Arrived { at: at(ms), what };
        self.driver.handle(at(ms), arrived, Some(&mut self.session));
    }

    /// 30 Hz from `from` to `to`, ms.
    fn moves(&mut self, from: i64, to: i64, engage: Option<bool>) {
        for ms in (from..to).step_by(33) {
            self.frame(ms, engage);
            self.advise(ms);
        }
    }

    fn advise(&mut self, ms: i64) -> bool {
        self.driver.advise(at(ms), &mut self.session)
    }

    fn requests(&self) -> u32 {
        self.session.requests()
    }

    fn engaged(&mut self, ms: i64) {
        let event = Event::Engaged {
            engagement: 1,
            t_us: ms * 1000,
            hand_m: [0.0; 3],
            tip_m: [0.0; 3],
            hand_q: None,
            tip_q: nalgebra::UnitQuaternion::identity(),
        };
        self.driver.on_event(at(ms), &event);
    }

    fn notes(&mut self) -> String {
        std::iter::from_fn(|| self.driver.poll_note())
            .collect::<Vec<_>>()
            .join("; ")
    }
}

#[test]
fn the_clutch_engages_on_a_press_and_silence_lets_go_until_the_next() {
    let mut bench = Bench::new(Habits::default());
    bench.moves(0, 300, None);
    assert_eq!(bench.requests(), 0, "nobody pressed");
    bench.moves(300, 600, Some(true));
    assert_eq!(bench.requests(), 1, "held is pressed once");
    bench.engaged(600);
    // Silence: a look a moment before, and one after.
    let due = bench.driver.poll_timeout().unwrap();
    assert!(!bench.advise(due.0 / 1_000_000 - 1));
    assert_eq!(bench.driver.tally().lost, 0);
    bench.advise(due.0 / 1_000_000 + 1);
    assert_eq!(bench.driver.tally().lost, 1);
    assert!(bench.notes().contains("lost"));
    assert_eq!(bench.driver.poll_timeout(), None, "lost once");
    // It comes back with the clutch still held: nothing is engaged by that.
    bench.moves(1000, 1500, Some(true));
    assert_eq!(bench.requests(), 1);
    assert!(bench.notes().contains("engage again"));
    bench.moves(1500, 1600, Some(false));
    bench.moves(1600, 1800, Some(true));
    assert_eq!(bench.requests(), 2);
}

#[test]
fn an_arm_that_stopped_a_lost_link_and_an_end_let_go_too() {
    let mut bench = Bench::new(Habits {
        engage: true,
        until_end: true,
    });
    bench.moves(0, 300, None);
    assert_eq!(
        bench.requests(),
        1,
        "--engage presses with the first sample"
    );
    bench.engaged(300);
    let held = Event::State(RobotState::Holding, Cause::LeaseExpired);
    bench.driver.on_event(at(310), &held);
    bench.moves(330, 600, None);
    assert_eq!(bench.requests(), 1, "--engage does so once");
    bench.driver.word(at(600), true, Some(&mut bench.session));
    assert_eq!(bench.requests(), 2, "a person may");
    bench.engaged(610);
    bench.driver.on_lost();
    bench.moves(630, 900, Some(false));
    bench.driver.word(at(900), true, None);
    assert!(bench.notes().contains("there is no link"));
    bench.moves(910, 1000, Some(true));
    assert_eq!(bench.requests(), 3);
    bench.engaged(1000);
    bench.put(1010, What::End("nothing more to read".into()));
    assert!(!bench.advise(1011));
    let leave = bench.driver.poll_timeout().unwrap();
    assert!(
        bench.driver.advise(leave, &mut bench.session),
        "--until-end"
    );
    bench.driver.word(at(1100), true, Some(&mut bench.session));
    assert_eq!(bench.requests(), 3, "there is no hand to follow");
}

#[test]
fn a_declined_press_is_repeated_where_the_reason_passes() {
    let mut bench = Bench::new(Habits::default());
    bench.moves(0, 100, None);
    bench.frame(100, Some(true));
    assert_eq!(bench.requests(), 1);
    bench
        .driver
        .on_event(at(110), &Event::Refused(Refusal::Moving));
    bench.moves(133, 250, Some(true));
    assert_eq!(bench.requests(), 2);
    bench
        .driver
        .on_event(at(250), &Event::Refused(Refusal::NotYours));
    bench.moves(266, 500, Some(true));
    assert_eq!(bench.requests(), 2);
    assert!(bench.notes().contains("NotYours"));
}

#[test]
fn frames_out_of_order_are_dropped_and_a_restarted_sender_is_not() {
    let mut bench = Bench::new(Habits::default());
    bench.timed = true;
    bench.moves(0, 330, None);
    let taken = bench.driver.tally().samples;
    let stale = Frame {
        t_s: Some(77.1),
        hand: Some(Place {
            position: Vector3::zeros(),
            orientation: None,
            grip: None,
        }),
        engage: None,
    };
    for ms in [335, 340] {
        bench.put(ms, What::Frame(stale));
    }
    assert_eq!(bench.driver.tally().of(Kind::Backwards), 2);
    assert_eq!(bench.notes().matches("dropped").count(), 1, "told once");
    assert_eq!(bench.driver.tally().samples, taken);
    // Its clock begins anew after a pause that is a loss.
    let pause_ms = 330 + (LOST_S * 1e3) as i64;
    let again = Frame {
        t_s: Some(0.01),
        ..stale
    };
    bench.put(pause_ms, What::Frame(again));
    assert_eq!(bench.driver.tally().samples, taken + 1);
    assert_eq!(bench.driver.tally().lost, 1);
}
