use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use nalgebra::{UnitQuaternion, Vector3};
use proptest::prelude::*;
use telemime_protocol::time::Stamp;

use super::*;
use crate::cli::Axes;
use crate::input::read::{Inlet, channel};
use crate::input::{Arrived, Driver, Habits};
use crate::session::{Event, LOST_S};
use crate::task::tests::ready;

const X: u16 = 0;
const Y: u16 = 1;
const Z: u16 = 2;
const RX: u16 = 3;
const RY: u16 = 4;
const RZ: u16 = 5;
const PAD_HOLD: u16 = 0x136;
const PAD_GRIP: u16 = 0x137;
const MOUSE_HOLD: u16 = 0x100;

fn has(keys: &[u16], absolute: &[(u16, i32, i32)], relative: &[u16]) -> Abilities {
    let range = |&(code, low, high): &(u16, i32, i32)| (code, Range { low, high });
    Abilities {
        keys: keys.iter().copied().collect(),
        absolute: absolute.iter().map(range).collect(),
        relative: relative.iter().copied().collect(),
    }
}

/// An Xbox pad: sticks of 16 bits, triggers in Z and RZ, a hat.
fn pad() -> Abilities {
    let stick = |code| (code, -32768, 32767);
    let trigger = |code| (code, 0, 255);
    has(
        &[0x130, 0x131, 0x133, 0x134, PAD_HOLD, PAD_GRIP, 0x13a, 0x13b],
        &[
            stick(X),
            stick(Y),
            trigger(Z),
            stick(RX),
            stick(RY),
            trigger(RZ),
            (0x10, -1, 1),
        ],
        &[],
    )
}

fn space_mouse_relative() -> Abilities {
    has(&[0x100, 0x101], &[], &[X, Y, Z, RX, RY, RZ])
}

/// A device whose hand is in the robot's own axes: x forward, y left, z up.
struct Bench {
    stick: Stick,
    now: Stamp,
}

impl Bench {
    fn new(has: &Abilities) -> Self {
        Self::with(has, Manner::default())
    }

    fn with(has: &Abilities, manner: Manner) -> Self {
        let mut bench = Self {
            stick: Stick::new(&Layout::of(has).unwrap(), manner),
            now: Stamp(1_000_000_000),
        };
        bench.tick();
        bench
    }

    fn says(&mut self, control: Control, code: u16, value: i32) {
        self.stick.handle(Change {
            control,
            code,
            value,
            t: self.now,
        });
    }

    fn key(&mut self, code: u16, value: i32) {
        self.says(Control::Key, code, value);
    }

    fn axis(&mut self, code: u16, value: i32) {
        self.says(Control::Absolute, code, value);
    }

    fn tick(&mut self) -> (Option<Frame>, Frame) {
        self.now = Stamp(self.now.0 + 10_000_000);
        self.stick.tick(self.now)
    }

    fn place(&mut self) -> Place {
        self.tick().1.hand.unwrap()
    }

    /// How far the hand goes in a second.
    fn second(&mut self) -> Vector3<f64> {
        let from = self.stick.place;
        for _ in 0..100 {
            self.tick();
        }
        self.stick.place - from
    }
}

fn is_near(a: Vector3<f64>, b: [f64; 3]) {
    assert!((a - Vector3::from(b)).norm() < 1e-5, "{a} {b:?}");
}

#[test]
fn a_device_is_known_by_what_it_has() {
    let make = |has: &Abilities| Layout::of(has).map(|layout| layout.make);
    assert_eq!(make(&pad()), Some(Make::Gamepad));
    let byte = |code| (code, 0, 255);
    let plain = [byte(X), byte(Y), byte(Z), byte(RZ)];
    let keys = [0x130, PAD_HOLD, PAD_GRIP];
    assert_eq!(make(&has(&keys, &plain, &[])), Some(Make::Gamepad));
    let six = [X, Y, Z, RX, RY, RZ];
    let absolute = six.map(|code| (code, -350, 350));
    let buttons = [0x100, 0x101];
    assert_eq!(make(&has(&buttons, &absolute, &[])), Some(Make::SpaceMouse));
    assert_eq!(make(&space_mouse_relative()), Some(Make::SpaceMouse));
    for other in [
        // Nothing; a keyboard; a mouse; a joystick; a touch pad; a pad without shoulders, and one with a single stick.
        has(&[], &[], &[]),
        has(&(1..120).collect::<Vec<_>>(), &[], &[]),
        has(&[0x110, 0x111], &[], &[X, Y]),
        has(&[0x120, 0x121], &plain, &[]),
        has(&[0x14a, 0x145], &[byte(X), byte(Y)], &[]),
        has(&[0x130, 0x131], &plain, &[]),
        has(&keys, &plain[..3], &[]),
        has(&buttons, &absolute[..5], &[]),
    ] {
        assert_eq!(make(&other), None, "{other:?}");
    }
}

#[test]
fn a_deflection_is_a_speed_and_rest_is_rest() {
    let mut bench = Bench::new(&pad());
    bench.key(PAD_HOLD, 1);
    is_near(bench.second(), [0.0; 3]);
    // A stick that does not come back exactly, on either side.
    for value in [3900, -3900] {
        bench.axis(Y, value);
        is_near(bench.second(), [0.0; 3]);
    }
    // Away from the person is the least count, and forward.
    bench.axis(Y, -32768);
    is_near(bench.second(), [SPEED_M_S, 0.0, 0.0]);
    // The kernel says nothing more while it is held there.
    is_near(bench.second(), [SPEED_M_S, 0.0, 0.0]);
    bench.axis(Y, 0);
    bench.axis(X, 32767);
    is_near(bench.second(), [0.0, -SPEED_M_S, 0.0]);
    // Half of what is left beyond the dead zone is half of the speed.
    let half = 0.5 * (1.0 + DEAD_ZONE);
    bench.axis(X, (-half * 32767.5).round() as i32);
    is_near(bench.second(), [0.0, SPEED_M_S / 2.0, 0.0]);
    bench.axis(X, 0);
    bench.axis(RY, -32768);
    is_near(bench.second(), [0.0, 0.0, SPEED_M_S]);
    // Everything at once is no faster, and beyond the range is the end of it.
    bench.axis(X, i32::MAX);
    bench.axis(Y, i32::MIN);
    let third = SPEED_M_S / 3.0_f64.sqrt();
    is_near(bench.second(), [third, -third, third]);
}

#[test]
fn an_axis_is_scaled_by_its_own_range() {
    let byte = |code| (code, 0, 255);
    let keys = [0x130, PAD_HOLD, PAD_GRIP];
    let axes = [byte(X), byte(Y), byte(Z), byte(RZ)];
    let manner = Manner {
        speed_m_s: 1.0,
        ..Manner::default()
    };
    let mut bench = Bench::with(&has(&keys, &axes, &[]), manner);
    bench.key(PAD_HOLD, 1);
    is_near(bench.second(), [0.0; 3]);
    for (value, moved) in [(127, 0.0), (128, 0.0), (255, -1.0), (0, 1.0)] {
        bench.axis(RZ, value);
        is_near(bench.second(), [0.0, 0.0, moved]);
    }
    // A range that is none, or the wrong way round, moves nothing.
    for (low, high) in [(0, 0), (255, 0)] {
        let axes = [byte(X), (Y, low, high), byte(Z), byte(RZ)];
        let mut bench = Bench::new(&has(&keys, &axes, &[]));
        bench.key(PAD_HOLD, 1);
        bench.axis(Y, 200);
        is_near(bench.second(), [0.0; 3]);
    }
}

#[test]
fn forward_is_forward_in_the_axes_of_a_tracker_too() {
    let manner = Manner {
        rotation: Axes::Kinect.rotation(),
        ..Manner::default()
    };
    let mut bench = Bench::with(&pad(), manner);
    bench.key(PAD_HOLD, 1);
    bench.axis(Y, -32768);
    is_near(bench.second(), [0.0, 0.0, -SPEED_M_S]);
    bench.axis(Y, 0);
    bench.axis(RY, -32768);
    is_near(bench.second(), [0.0, SPEED_M_S, 0.0]);
}

#[test]
fn the_hand_moves_only_while_the_button_is_held() {
    let mut bench = Bench::new(&pad());
    bench.axis(Y, -32768);
    is_near(bench.second(), [0.0; 3]);
    let held = |frames: (Option<Frame>, Frame)| {
        let before = frames.0.map(|frame| (frame.engage, frame.hand.is_some()));
        (before, frames.1.engage)
    };
    assert_eq!(held(bench.tick()), (None, Some(false)));
    bench.key(PAD_HOLD, 1);
    assert_eq!(held(bench.tick()), (None, Some(true)));
    // A key that repeats is held.
    bench.key(PAD_HOLD, 2);
    assert_eq!(held(bench.tick()), (None, Some(true)));
    // Let go and pressed between two ticks: both are told, in this order.
    bench.key(PAD_HOLD, 0);
    bench.key(PAD_HOLD, 1);
    let both = (Some((Some(false), false)), Some(true));
    assert_eq!(held(bench.tick()), both);
    assert_eq!(held(bench.tick()), (None, Some(true)), "once");
    // However often: two frames a tick.
    for _ in 0..100_000 {
        bench.key(PAD_HOLD, 0);
        bench.key(PAD_HOLD, 1);
    }
    assert_eq!(held(bench.tick()), both);
    bench.key(PAD_HOLD, 0);
    assert_eq!(held(bench.tick()), (None, Some(false)));
    is_near(bench.second(), [0.0; 3]);
    // Another button is no clutch.
    bench.key(0x130, 1);
    assert_eq!(held(bench.tick()), (None, Some(false)));
}

#[test]
fn a_button_that_was_held_when_the_device_was_opened_is_not_a_press() {
    let mut stick = Stick::new(&Layout::of(&pad()).unwrap(), Manner::default());
    let t = Stamp(1_000_000_000);
    let key = |stick: &mut Stick, value| {
        stick.handle(Change {
            control: Control::Key,
            code: PAD_HOLD,
            value,
            t,
        });
        stick.tick(t).1.engage
    };
    assert_eq!(key(&mut stick, 1), Some(false));
    assert_eq!(key(&mut stick, 2), Some(false), "nor when it repeats");
    assert_eq!(key(&mut stick, 0), Some(false));
    assert_eq!(key(&mut stick, 1), Some(true));
}

#[test]
fn the_gripper_is_left_alone_until_its_button_is_pressed_while_the_other_is_held() {
    let mut bench = Bench::new(&pad());
    bench.key(PAD_GRIP, 1);
    bench.key(PAD_GRIP, 0);
    assert_eq!(bench.place().grip, None, "not held");
    bench.key(PAD_HOLD, 1);
    assert_eq!(bench.place().grip, None);
    for grip in [0.0, 1.0, 0.0] {
        bench.key(PAD_GRIP, 1);
        assert_eq!(bench.place().grip, Some(grip));
        bench.key(PAD_GRIP, 2);
        bench.key(PAD_GRIP, 0);
        assert_eq!(bench.place().grip, Some(grip), "once a press");
    }
    bench.key(PAD_HOLD, 0);
    bench.key(PAD_GRIP, 1);
    assert_eq!(bench.place().grip, Some(0.0));
}

#[test]
fn a_relative_axis_rests_when_it_is_not_repeated() {
    let mut bench = Bench::new(&space_mouse_relative());
    bench.key(MOUSE_HOLD, 1);
    for _ in 0..50 {
        bench.says(Control::Relative, Y, -350);
        bench.tick();
        bench.tick();
    }
    is_near(bench.stick.place, [SPEED_M_S, 0.0, 0.0]);
    // The cap springs back: the last report goes on for as long as one may be late.
    let coasted = bench.second().norm();
    assert!(coasted <= SPEED_M_S * RELATIVE_STANDS_S, "{coasted}");
    is_near(bench.second(), [0.0; 3]);
    // Its turning is not followed.
    bench.says(Control::Relative, RX, 350);
    is_near(bench.second(), [0.0; 3]);
}

#[test]
fn a_thread_that_was_held_up_makes_no_leap_and_the_hand_does_not_leave_the_world() {
    let mut bench = Bench::new(&pad());
    bench.key(PAD_HOLD, 1);
    bench.axis(Y, -32768);
    bench.now = Stamp(bench.now.0 + 5_000_000_000);
    let place = bench.place().position;
    assert!(
        place.norm() <= SPEED_M_S * LONGEST_STEP_S + 1e-12,
        "{place}"
    );
    bench.stick.place = Vector3::new(FARTHEST_M - 0.01, 0.0, 0.0);
    bench.second();
    assert_eq!(bench.stick.place.x, FARTHEST_M);
    bench.axis(Y, 32767);
    assert!(bench.second().x < -0.2, "and comes back");
}

fn change() -> impl Strategy<Value = (u8, u16, i32, i64)> {
    let code = prop_oneof![0_u16..8, Just(PAD_HOLD), Just(PAD_GRIP), any::<u16>()];
    let value = prop_oneof![any::<i32>(), Just(i32::MIN), Just(i32::MAX), 0..3];
    (0_u8..3, code, value, -50_000_000_i64..100_000_000)
}

proptest! {
    #[test]
    fn whatever_is_reported_the_hand_is_a_place_and_no_faster_than_asked(
        changes in proptest::collection::vec(change(), 1..200),
        (low, high) in (any::<i32>(), any::<i32>()),
    ) {
        let mut has = pad();
        has.absolute.insert(Y, Range { low, high });
        let mut bench = Bench::new(&has);
        let mut before = bench.stick.place;
        for (control, code, value, ns) in changes {
            let control = [Control::Key, Control::Absolute, Control::Relative][usize::from(control)];
            bench.says(control, code, value);
            bench.now = Stamp(bench.now.0 + ns);
            let place = bench.place().position;
            let moved = (place - before).norm();
            prop_assert!(moved <= SPEED_M_S * LONGEST_STEP_S + 1e-12, "{moved}");
            before = place;
        }
    }
}

/// The frames of `stick` by a clock that goes on with every read; `read` has the number of the tick.
fn followed(
    stick: Stick,
    mut read: impl FnMut(&mut Stick, Stamp, usize) -> io::Result<()>,
) -> Inlet {
    let clock = Arc::new(AtomicI64::new(0));
    let shown = Arc::clone(&clock);
    let (to, inlet) = channel(Box::new(move || Stamp(shown.load(Ordering::Relaxed))));
    let mut tick = 0;
    let read = |stick: &mut Stick, now: Stamp| {
        clock.fetch_add(11_000_000, Ordering::Relaxed);
        tick += 1;
        read(stick, now, tick - 1)
    };
    follow(stick, read, to);
    inlet
}

#[test]
fn a_silent_device_is_there_and_one_that_is_gone_lets_go() {
    let layout = Layout::of(&pad()).unwrap();
    let stick = Stick::new(&layout, Manner::default());
    let say = |stick: &mut Stick, control, code, value, t| {
        stick.handle(Change {
            control,
            code,
            value,
            t,
        });
    };
    // Held and deflected at the second tick, and not a word for a second and a half: then it is pulled out.
    let ticks = 150;
    let mut inlet = followed(stick, |stick, now, tick| {
        if tick == 1 {
            say(stick, Control::Key, PAD_HOLD, 1, now);
            say(stick, Control::Absolute, Y, -32768, now);
        }
        match tick {
            _ if tick == ticks => Err(io::Error::other("No such device")),
            _ => Ok(()),
        }
    });
    let arrived: Vec<Arrived> = std::iter::from_fn(|| inlet.arrived.try_recv().ok()).collect();
    assert_eq!(arrived.len(), ticks + 1);
    let mut session = ready();
    let mut driver = Driver::new(inlet, Habits::default());
    driver.on_event(Stamp(0), &Event::Ready);
    for arrived in arrived {
        let now = arrived.at;
        let ends = matches!(arrived.what, What::End(_));
        if ends {
            assert_eq!(session.requests(), 1, "held is pressed once");
            assert_eq!(driver.poll_note().as_deref(), Some("the hand is seen"));
            driver.word(now, true, Some(&mut session));
            assert_eq!(driver.poll_note(), None, "it is held");
            assert_eq!(driver.tally().lost, 0, "silence is no loss");
            let due = driver.poll_timeout().unwrap();
            assert!(due.secs_since(now) > 0.9 * LOST_S, "it was just heard");
        }
        driver.handle(now, arrived, Some(&mut session));
        driver.advise(now, &mut session);
        if now.0 == 22_000_000 {
            let event = Event::Engaged {
                engagement: 1,
                t_us: 22_000,
                hand_m: [0.0; 3],
                tip_m: [0.0; 3],
                hand_q: None,
                tip_q: UnitQuaternion::identity(),
            };
            driver.on_event(now, &event);
        }
    }
    let told: Vec<_> = std::iter::from_fn(|| driver.poll_note()).collect();
    let told = told.join("; ");
    assert!(told.contains("gone (No such device)"), "{told}");
    assert_eq!(driver.tally().samples, ticks as u64);
    // It is let go: what nobody holds may be pressed, and there is no hand to follow.
    driver.word(Stamp(2_000_000_000), true, Some(&mut session));
    assert!(driver.poll_note().unwrap().contains("no hand is seen"));
    assert_eq!(session.requests(), 1);
}

#[test]
fn frames_that_nobody_takes_are_counted_and_not_kept() {
    let layout = Layout::of(&pad()).unwrap();
    let stick = Stick::new(&layout, Manner::default());
    let (to, inlet) = channel(Box::new(|| Stamp(0)));
    let overflow = Arc::clone(&inlet.overflow);
    let taken = inlet.arrived.max_capacity() as u64;
    // Without the wait: the clock of the test stands.
    for _ in 0..1000 {
        let (_, frame) = stick.clone().tick(to.now());
        assert!(to.put(Stamp(0), What::Frame(frame)));
    }
    assert_eq!(overflow.load(Ordering::Relaxed), 1000 - taken);
    drop(inlet);
    // Nobody is there any more, which ends it at its first frame.
    let mut reads = 0;
    follow(
        stick,
        |_, _| {
            reads += 1;
            Ok(())
        },
        to,
    );
    assert_eq!(reads, 1);
}
