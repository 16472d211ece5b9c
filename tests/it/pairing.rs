//! How an operator comes to be trusted, and stops being: windows, codes, revocation.

use std::time::Duration;

use quinn::Connection;
use telemime::ground::{Pair, run_virtual};
use telemime_endpoint::cli::Word;
use telemime_endpoint::pairing::{self, Own, PairError};
use telemime_endpoint::{Identity, Standing};
use telemime_operator::daemon::DaemonError;
use telemime_operator::task::Outcome;
use telemime_protocol::wire::pair::{AbortCode, MAGIC, Name, PairMessage};
use telemime_protocol::wire::v1::{Cause, RobotState};
use telemime_robot::daemon::Notice as RobotNotice;
use telemime_robot::desk::Progress;
use telemime_robot::refused::Reason;

use crate::scene::{delayed, finish, mirroring, replay, rig, skill, unseen};

const WINDOW: Duration = Duration::from_secs(60);

fn own(identity: &Identity) -> Own {
    Own {
        name: Name::new("laptop").unwrap(),
        key: identity.fingerprint(),
    }
}

/// What the robot told about pairing so far.
fn told(pair: &Pair) -> Vec<Progress> {
    let progress = |n: &RobotNotice| match n {
        RobotNotice::Pairing(progress) => Some(progress.clone()),
        _ => None,
    };
    pair.robot.notices().iter().filter_map(progress).collect()
}

fn last(pair: &Pair) -> Progress {
    told(pair).pop().unwrap()
}

fn refused(pair: &Pair, reason: Reason) -> Vec<u32> {
    let times = |n: &RobotNotice| match n {
        RobotNotice::Refused(refused) if refused.reason == reason => Some(refused.times),
        _ => None,
    };
    pair.robot.notices().iter().filter_map(times).collect()
}

/// A connection for pairing by `identity`, or why there is none.
async fn suit(pair: &mut Pair, identity: &Identity, seed: u64) -> Result<Connection, PairError> {
    let endpoint = pair.suitor(identity, &delayed(0.03), seed).unwrap();
    let connecting = endpoint.connect(pair.robot_addr(), "telemime").unwrap();
    Ok(connecting.await?)
}

/// Offers `identity` and gives the operator's `word`; the robot's is given by the caller.
async fn paired(
    pair: &mut Pair,
    identity: &Identity,
    seed: u64,
    word: Result<(), PairError>,
) -> tokio::task::JoinHandle<Result<pairing::Candidate, PairError>> {
    let connection = suit(pair, identity, seed).await;
    let own = own(identity);
    let task = async move {
        let offered = pairing::offer(&connection?, &own).await?;
        offered.settle(async move { word }).await
    };
    let task = tokio::task::spawn_local(task);
    pair.run_for(0.5).await;
    task
}

fn ours(error: &PairError) -> AbortCode {
    match error {
        PairError::Ours { code, .. } | PairError::Peer { code, .. } => *code,
        other => panic!("{other}"),
    }
}

#[test]
fn both_users_see_one_code_and_only_then_the_key_is_trusted() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let laptop = Identity::ephemeral().unwrap();
        pair.robot.say(Word::Pair(WINDOW));
        pair.run_for(0.1).await;
        assert_eq!(last(&pair), Progress::Open(WINDOW));
        let pairing = paired(&mut pair, &laptop, 1, Ok(())).await;
        let Progress::Code(shown) = last(&pair) else {
            panic!("{:?}", told(&pair))
        };
        assert_eq!(shown.key, laptop.fingerprint());
        assert_eq!(
            pair.trust.standing(laptop.fingerprint()),
            Standing::Unknown,
            "the operator's word alone is not enough"
        );
        pair.robot.say(Word::Yes);
        let robot = pairing.await.unwrap().unwrap();
        assert_eq!((robot.key, robot.code), (pair.robot_key(), shown.code));
        assert_eq!(pair.trust.standing(laptop.fingerprint()), Standing::Trusted);
        assert!(matches!(last(&pair), Progress::Paired(_)));

        // And it drives.
        let (skill, config) = (Some(skill()), Default::default());
        let link = delayed(0.03);
        let operator = pair.operator_as(&laptop, replay(unseen()), skill, config, &link, 2);
        let (summary, _, _) = finish(operator.unwrap()).await;
        assert_eq!(summary.unwrap().outcome, Outcome::Completed);
    })
    .unwrap();
}

#[test]
fn without_a_window_nobody_is_paired() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let laptop = Identity::ephemeral().unwrap();
        let none = suit(&mut pair, &laptop, 3).await;
        // The client's handshake seems complete before the robot has seen its key.
        let error = match none {
            Err(e) => e,
            Ok(connection) => connection.closed().await.into(),
        };
        assert_eq!(error, PairError::NoWindow);
        assert_eq!(refused(&pair, Reason::UnknownKey), [1]);
        // A key that is trusted already gets through TLS, and hears the same in words.
        let endpoint = pair.stranger(&delayed(0.03), 4).unwrap();
        drop(endpoint);
        assert!(told(&pair).is_empty());
    })
    .unwrap();
}

#[test]
fn a_no_on_either_side_stores_nothing_and_uses_the_window_up() {
    run_virtual(async {
        for (operators, robots) in [(pairing::word(false), Word::Yes), (Ok(()), Word::No)] {
            let mut pair = Pair::start(&rig()).unwrap();
            let laptop = Identity::ephemeral().unwrap();
            pair.robot.say(Word::Pair(WINDOW));
            pair.run_for(0.1).await;
            let pairing = paired(&mut pair, &laptop, 5, operators).await;
            pair.robot.say(robots);
            let error = pairing.await.unwrap().unwrap_err();
            assert_eq!(ours(&error), AbortCode::Declined);
            pair.run_for(0.5).await;
            assert!(matches!(
                last(&pair),
                Progress::Ended(_) | Progress::Nothing
            ));
            assert_eq!(pair.trust.standing(laptop.fingerprint()), Standing::Unknown);
            let again = paired(&mut pair, &laptop, 6, Ok(())).await;
            assert_eq!(again.await.unwrap().unwrap_err(), PairError::NoWindow);
            // A window is not opened again at once, so that codes cannot be guessed quickly.
            pair.robot.say(Word::Pair(WINDOW));
            pair.run_for(0.1).await;
            assert!(matches!(last(&pair), Progress::TooSoon(_)));
        }
    })
    .unwrap();
}

#[test]
fn a_window_ends_and_takes_an_undecided_attempt_with_it() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let laptop = Identity::ephemeral().unwrap();
        pair.robot.say(Word::Pair(Duration::from_secs(2)));
        pair.run_for(2.5).await;
        let Progress::Ended(why) = last(&pair) else {
            panic!("{:?}", told(&pair))
        };
        assert_eq!(ours(&why), AbortCode::Expired);
        let late = paired(&mut pair, &laptop, 7, Ok(())).await;
        assert_eq!(late.await.unwrap().unwrap_err(), PairError::NoWindow);

        pair.run_for(5.0).await;
        pair.robot.say(Word::Pair(Duration::from_secs(2)));
        pair.run_for(0.1).await;
        let undecided = paired(&mut pair, &laptop, 8, Ok(())).await;
        assert!(matches!(last(&pair), Progress::Code(_)));
        let error = undecided.await.unwrap().unwrap_err();
        assert_eq!(ours(&error), AbortCode::Expired);
        pair.robot.say(Word::Yes);
        pair.run_for(0.2).await;
        assert_eq!(last(&pair), Progress::Nothing, "too late");
        assert_eq!(pair.trust.standing(laptop.fingerprint()), Standing::Unknown);
    })
    .unwrap();
}

#[test]
fn a_window_is_for_one_attempt_and_lets_nobody_drive() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let (laptop, stranger) = (
            Identity::ephemeral().unwrap(),
            Identity::ephemeral().unwrap(),
        );
        pair.robot.say(Word::Pair(WINDOW));
        pair.run_for(0.1).await;
        // TLS lets a stranger through now, and that is all.
        let (skill, config) = (Some(skill()), Default::default());
        let link = delayed(0.03);
        let driver = pair.operator_as(&stranger, replay(unseen()), skill, config, &link, 9);
        let (result, _, _) = finish(driver.unwrap()).await;
        assert!(
            matches!(result, Err(DaemonError::Unreachable { .. })),
            "{result:?}"
        );
        assert!(refused(&pair, Reason::UnknownKey).contains(&1));
        let moved = |n: &RobotNotice| matches!(n, RobotNotice::Connected { .. });
        assert!(!pair.robot.notices().iter().any(moved));

        let first = paired(&mut pair, &laptop, 10, Ok(())).await;
        let second = paired(&mut pair, &stranger, 11, Ok(())).await;
        assert_eq!(second.await.unwrap().unwrap_err(), PairError::NoWindow);
        pair.robot.say(Word::Yes);
        assert_eq!(first.await.unwrap().unwrap().key, pair.robot_key());
        assert_eq!(
            pair.trust.standing(stranger.fingerprint()),
            Standing::Unknown
        );
    })
    .unwrap();
}

#[test]
fn somebody_in_between_makes_the_codes_differ() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let mut between = Pair::start(&rig()).unwrap();
        let laptop = Identity::ephemeral().unwrap();
        // The laptop is led to another robot, whose owner plays the laptop towards ours: two honest halves.
        for ground in [&pair, &between] {
            ground.robot.say(Word::Pair(WINDOW));
            ground.run_for(0.1).await;
        }
        let mallory = Identity::ephemeral().unwrap();
        let to_ours = paired(&mut pair, &mallory, 12, Ok(())).await;
        let to_mallory = paired(&mut between, &laptop, 13, Ok(())).await;
        let code = |ground: &Pair| match last(ground) {
            Progress::Code(candidate) => candidate.code,
            other => panic!("{other:?}"),
        };
        assert_ne!(code(&pair), code(&between));
        pair.robot.say(Word::No);
        assert!(to_ours.await.unwrap().is_err());
        to_mallory.abort();
    })
    .unwrap();
}

#[test]
fn an_end_that_is_silent_is_told_so() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let laptop = Identity::ephemeral().unwrap();
        pair.robot.say(Word::Pair(WINDOW));
        pair.run_for(0.1).await;
        let connection = suit(&mut pair, &laptop, 12).await.unwrap();
        let (mut send, mut recv) = connection.open_bi().await.unwrap();
        let offer = PairMessage::Offer(own(&laptop).name);
        send.write_all(&offer.encode()).await.unwrap();
        let said = recv.read_to_end(256).await.unwrap();
        let (commit, used) = PairMessage::decode(&said).unwrap().unwrap();
        assert!(matches!(commit, PairMessage::Commit(..)));
        let (abort, _) = PairMessage::decode(&said[used..]).unwrap().unwrap();
        let PairMessage::Abort(AbortCode::Malformed, text) = abort else {
            panic!("{abort:?}");
        };
        assert!(text.contains("said nothing for 5 s"), "{text}");
    })
    .unwrap();
}

#[test]
fn a_robot_that_reveals_another_nonce_than_it_committed_to_is_caught() {
    run_virtual(async {
        let network = telemime::ground::Network::new();
        let at = |n: u8| std::net::SocketAddr::from(([192, 0, 2, n], 4433));
        let socket = |n: u8| telemime_endpoint::quic::Socket::Abstract {
            socket: network.socket(at(n)),
            seed: [n; 32],
        };
        let (robot, laptop) = (
            Identity::ephemeral().unwrap(),
            Identity::ephemeral().unwrap(),
        );
        let trust = telemime_endpoint::Trust::new([]);
        trust.set_open(true);
        let meter = telemime_endpoint::Meter::default();
        let server = telemime_endpoint::quic::server(&robot, &trust, socket(1), &meter).unwrap();
        let client = telemime_endpoint::quic::pairing_client(&laptop, socket(2)).unwrap();
        let cheat = async {
            let connection = server.accept().await.unwrap().await.unwrap();
            let (mut send, mut recv) = connection.accept_bi().await.unwrap();
            let mut buffer = [0; 256];
            recv.read(&mut buffer).await.unwrap();
            let name = Name::new("cheat").unwrap();
            let commit = PairMessage::Commit([1; 32], name).encode();
            send.write_all(&commit).await.unwrap();
            recv.read(&mut buffer).await.unwrap();
            let reveal = PairMessage::Reveal([2; 32]).encode();
            send.write_all(&reveal).await.unwrap();
            let n = recv.read(&mut buffer).await.unwrap().unwrap();
            PairMessage::decode(&buffer[..n]).unwrap().unwrap().0
        };
        let honest = async {
            let connection = client.connect(at(1), "telemime").unwrap().await.unwrap();
            pairing::offer(&connection, &own(&laptop)).await.err()
        };
        let (told, error) = tokio::join!(cheat, honest);
        assert_eq!(ours(&error.unwrap()), AbortCode::Commitment);
        assert!(matches!(told, PairMessage::Abort(AbortCode::Commitment, _)));
        assert_eq!(&MAGIC, b"TLMP");
    })
    .unwrap();
}

#[test]
fn a_revoked_operator_loses_its_session_and_is_told_why() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let operator = mirroring(&mut pair, &delayed(0.05), 14);
        assert!(
            pair.wait_for(10.0, |r| r.state == RobotState::Engaged)
                .await
        );
        pair.run_for(1.0).await;
        pair.trust.set([], [pair.operator_key()]);
        pair.run_for(0.5).await;
        let report = pair.robot.reports().last().copied().unwrap();
        assert_eq!(
            (report.state, report.cause),
            (RobotState::Holding, Cause::ConnectionLost)
        );
        let (result, _, notices) = finish(operator).await;
        assert!(
            matches!(result, Err(DaemonError::Revoked { .. })),
            "{result:?}"
        );
        let lost = format!("{notices:?}");
        assert!(lost.contains("key was revoked"), "{lost}");
        let times = refused(&pair, Reason::RevokedKey);
        assert_eq!(times.first(), Some(&1));
        assert!(times.len() <= 2, "told once, then counted: {times:?}");
    })
    .unwrap();
}

#[test]
fn a_robot_with_another_key_is_refused_hard() {
    run_virtual(async {
        let mut pair = Pair::start(&rig()).unwrap();
        let stranger = Identity::ephemeral().unwrap();
        let operator = pair
            .operator_that_expects(stranger.fingerprint(), replay(unseen()), &delayed(0.05), 15)
            .unwrap();
        let begun = pair.now();
        let (result, _, _) = finish(operator).await;
        let Err(DaemonError::KeyChanged { shown, .. }) = &result else {
            panic!("{result:?}")
        };
        assert_eq!(*shown, Some(pair.robot_key()));
        let said = result.unwrap_err().to_string();
        assert!(
            said.contains("in between") && said.contains("peers remove"),
            "{said}"
        );
        assert!(pair.now().secs_since(begun) < 0.5, "it is not tried again");
    })
    .unwrap();
}
