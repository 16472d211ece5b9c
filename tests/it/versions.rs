//! Ends of different ages: what both speak is the lower of the two maxima, or there is no session and both know why.

use telemime::ground::{Pair, run_virtual};
use telemime_operator::daemon::{DaemonError, Notice as OperatorNotice};
use telemime_operator::session::SessionConfig;
use telemime_operator::task::Outcome;
use telemime_protocol::wire::hello::RejectCode;
use telemime_protocol::wire::{Version, Versions};
use telemime_robot::daemon::Notice as RobotNotice;
use telemime_robot::session::SessionConfig as RobotConfig;

use crate::scene::{finish, replay, rig, shaped, skill, unseen};

const V1: (Version, Version) = (Version::V1, Version::V1);
const BOTH: (Version, Version) = (Version::V1, Version::V2);
const V2: (Version, Version) = (Version::V2, Version::V2);

/// The version a whole replay was mirrored in, as both ends say it, or why there was no session.
fn session(
    robot: (Version, Version),
    operator: (Version, Version),
) -> Result<Version, (RejectCode, String)> {
    let versions = |(lowest, highest)| Versions::new(lowest, highest).unwrap();
    run_virtual(async move {
        let config = RobotConfig {
            versions: versions(robot),
            ..RobotConfig::default()
        };
        let mut pair = Pair::start_with(&rig(), config).unwrap();
        let config = SessionConfig {
            versions: versions(operator),
            ..SessionConfig::default()
        };
        let operator = pair
            .operator(replay(unseen()), Some(skill()), config, &shaped(), 51)
            .unwrap();
        let (summary, _, notices) = finish(operator).await;
        let summary = match summary {
            Ok(summary) => summary,
            Err(DaemonError::Rejected { code, text, .. }) => return Err((code, text)),
            Err(e) => panic!("{e}"),
        };
        assert_eq!((summary.outcome, summary.sessions), (Outcome::Completed, 1));
        // Until the robot has heard the goodbye.
        pair.run_for(1.0).await;
        let told = notices.iter().find_map(|n| match n {
            OperatorNotice::Connected { version, .. } => Some(*version),
            _ => None,
        });
        let robot_notices = pair.robot.notices();
        let known = robot_notices.iter().find_map(|n| match n {
            RobotNotice::Connected { version, .. } => Some(*version),
            _ => None,
        });
        assert_eq!(told, known);
        // A pong read in the wrong version would have put the session clock off, or dropped it.
        // The last: a dial whose answer came too late was a session to the robot.
        let ended = robot_notices.iter().rev().find_map(|n| match n {
            RobotNotice::Disconnected {
                clock, counters, ..
            } => Some((*clock, counters.dropped)),
            _ => None,
        });
        let (clock, dropped) = ended.expect("the session ended");
        let (offset_s, bound_s) = clock.expect("a clock");
        assert!(
            bound_s < 0.25 && offset_s.abs() < 1e4,
            "{offset_s} {bound_s}"
        );
        // One of a dial that came too late.
        assert!(dropped <= 1, "{dropped}");
        Ok(told.expect("connected"))
    })
    .unwrap()
}

#[test]
fn ends_of_different_ages_speak_the_older_ones_version() {
    assert_eq!(session(V1, BOTH), Ok(Version::V1), "an older robot");
    assert_eq!(session(BOTH, V1), Ok(Version::V1), "an older operator");
    assert_eq!(session(BOTH, BOTH), Ok(Version::V2));
}

#[test]
fn ends_with_nothing_in_common_say_so() {
    for (robot, operator, words) in [
        (V1, V2, "speaks version 1, you offer 2 to 2"),
        (V2, V1, "speaks version 2, you offer 1 to 1"),
    ] {
        let (code, text) = session(robot, operator).unwrap_err();
        assert_eq!(code, RejectCode::Version);
        assert!(text.contains(words), "{text}");
    }
}

#[test]
fn the_experiment_is_not_spoken_by_default() {
    assert_eq!(RobotConfig::default().versions, Versions::default());
    assert_eq!(SessionConfig::default().versions, Versions::default());
    let asked = telemime_endpoint::cli::versions;
    assert_eq!(asked(None), Ok(Versions::default()));
    assert_eq!(asked(Some(2)).ok(), Versions::new(BOTH.0, BOTH.1));
    let unknown = asked(Some(3)).unwrap_err().to_string();
    assert!(unknown.contains("--protocol-max 3"), "{unknown}");
}
