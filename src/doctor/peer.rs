//! The way to a robot: whether UDP reaches it, who answers, and what it speaks.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use telemime_endpoint::control::Control;
use telemime_endpoint::peers::{Peers, Role};
use telemime_endpoint::quic::{self, Refusal};
use telemime_endpoint::{Fingerprint, Identity, Meter, Trust, admin, cli, trust};
use telemime_protocol::wire::Versions;
use telemime_protocol::wire::hello::{Answer, RejectCode};
use telemime_protocol::wire::v1::{Message, OperatorControl};
use tokio::time::timeout;

use super::{Args, Finding};

/// A robot that has not answered by now does not.
const PATIENCE: Duration = Duration::from_secs(5);

/// What to do about silence.
const SILENCE: &str = "is telemime robot running there and listening on that port? Does a firewall let UDP pass both ways?";

pub(super) fn greet(args: &Args, connect: &str, peer_file: &Path) -> anyhow::Result<Vec<Finding>> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("no runtime")?;
    let file = args
        .identity
        .clone()
        .unwrap_or_else(|| admin::key_file(Role::Operator));
    // A key that is not there yet is made by the operator, not by who only looks.
    let ours = if file.exists() {
        Identity::load_or_create(&file)
    } else {
        Identity::ephemeral()
    };
    let Ok(ours) = ours else {
        // Said already.
        return Ok(Vec::new());
    };
    let known = Peers::load(peer_file).unwrap_or_default();
    let robot = known.robot(connect);
    let address = robot.and_then(|robot| robot.address.clone());
    let address = address.unwrap_or_else(|| connect.to_owned());
    let addr = match cli::resolve(&address) {
        Ok(addr) => addr,
        Err(e) => {
            let remedy = "write HOST:PORT, or the name of a robot that was paired (telemime peers)";
            return Ok(vec![Finding::fail("robot's address", e, remedy)]);
        }
    };
    let given = args.peer.as_deref().map(str::parse::<Fingerprint>);
    let pinned = given.transpose()?.or(robot.map(|robot| robot.key));
    Ok(runtime.block_on(ask(&ours, addr, pinned)))
}

async fn ask(ours: &Identity, addr: SocketAddr, pinned: Option<Fingerprint>) -> Vec<Finding> {
    let path = "path to the robot";
    let trust = Trust::new(pinned);
    let any: SocketAddr = if addr.is_ipv4() {
        ([0, 0, 0, 0], 0).into()
    } else {
        (std::net::Ipv6Addr::UNSPECIFIED, 0).into()
    };
    let no_socket = |e: String| vec![Finding::fail(path, e, "a UDP socket is needed")];
    let socket = match quic::Socket::bind(any) {
        Ok(socket) => socket,
        Err(e) => return no_socket(e.to_string()),
    };
    let endpoint = match quic::client(ours, trust.clone(), socket, &Meter::default()) {
        Ok(endpoint) => endpoint,
        Err(e) => return no_socket(e.to_string()),
    };
    let connecting = match endpoint.connect(addr, "telemime") {
        Ok(connecting) => connecting,
        Err(e) => return vec![Finding::fail(path, format!("{addr}: {e}"), SILENCE)],
    };
    let silent = || {
        let found = format!("no answer from {addr} within {} s", PATIENCE.as_secs());
        vec![Finding::fail(path, found, SILENCE)]
    };
    let reached = || Finding::ok(path, format!("UDP reaches {addr}, and something answers"));
    let connection = match timeout(PATIENCE, connecting).await {
        Err(_) => return silent(),
        Ok(Ok(connection)) => connection,
        Ok(Err(e)) => {
            return match refused(&e, &trust, pinned) {
                Some(finding) => vec![reached(), finding],
                None => vec![Finding::fail(
                    path,
                    format!("{addr}: {}", quic::explain(&e)),
                    SILENCE,
                )],
            };
        }
    };
    let rtt_ms = quic::least_rtt(&connection).as_secs_f64() * 1e3;
    let mut findings = vec![Finding::ok(
        path,
        format!("UDP reaches {addr}; round trip {rtt_ms:.1} ms"),
    )];
    if let Some(key) = trust::key_of(&connection) {
        findings.push(Finding::ok("robot's identity", key.short()));
    }
    findings.push(match timeout(PATIENCE, speak(&connection)).await {
        Err(_) => Finding::fail("robot's greeting", "none", SILENCE),
        Ok(Ok(finding)) => finding,
        Ok(Err(why)) => {
            let lost = connection.close_reason();
            let refusal = lost.and_then(|e| refused(&e, &trust, pinned));
            refusal.unwrap_or_else(|| Finding::fail("robot's greeting", why, SILENCE))
        }
    });
    connection.close(0_u32.into(), b"goodbye");
    let _ = timeout(PATIENCE, endpoint.wait_idle()).await;
    findings
}

/// Whose key was not accepted, if that is what ended the handshake.
fn refused(
    error: &quinn::ConnectionError,
    trust: &Trust,
    pinned: Option<Fingerprint>,
) -> Option<Finding> {
    let what = "robot's identity";
    Some(match quic::refusal(error)? {
        Refusal::KeyUnknown | Refusal::KeyRevoked => {
            let shown = trust.turned_away();
            let shown = shown.map_or_else(|| "none to be read".to_owned(), |key| key.to_string());
            match pinned {
                None => Finding::warn(
                    what,
                    format!("it is not known here; its key is {shown}"),
                    "pair: telemime pair HOST:PORT, while the robot has a pairing window open",
                ),
                Some(_) => Finding::fail(
                    what,
                    format!("it has another key than the one that is pinned: {shown}"),
                    "if the robot was set up anew, telemime peers remove, and pair again; if not, somebody is in between",
                ),
            }
        }
        Refusal::OurKeyUnknown => Finding::fail(
            "our identity",
            "the robot does not know our key",
            "pair (telemime pair HOST:PORT), or give our fingerprint (telemime identity) to its --peer",
        ),
        Refusal::OurKeyRevoked => Finding::fail(
            "our identity",
            "the robot has revoked our key",
            "telemime peers remove on the robot's host, and pair again",
        ),
        Refusal::Version => Finding::fail(
            "robot's version",
            quic::explain(error),
            "the same major version of Telemime is needed at both ends",
        ),
    })
}

async fn speak(connection: &quinn::Connection) -> Result<Finding, String> {
    let what = "robot's version";
    let offered = Versions::default();
    let mut control = Control::open(connection).await.map_err(|e| e.to_string())?;
    control
        .write(&offered.hello().encode())
        .await
        .map_err(|e| e.to_string())?;
    let answer = control.answer().await.map_err(|e| e.to_string())?;
    Ok(match answer {
        Answer::Ack { version, .. } => {
            let (writer, _frames) = control.into_frames();
            let _ = writer.message(&OperatorControl::Goodbye.encode());
            writer.finish(Duration::from_secs(1)).await;
            Finding::ok(
                what,
                format!("speaks protocol version {version} with us, and nobody else drives it"),
            )
        }
        Answer::Reject {
            code: RejectCode::Busy,
            text,
        } => Finding::ok(what, format!("speaks our protocol, and is in use: {text}")),
        Answer::Reject { text, .. } => Finding::fail(
            what,
            format!("it declines: {text}"),
            "the same version of Telemime is needed at both ends, or --protocol-max of the newer lowered",
        ),
    })
}
