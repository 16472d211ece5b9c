//! `telemime demo --console`: a robot, a link that can be set, and an operator with a page to teach and drive from.

use std::net::SocketAddr;
use std::path::Path;

use anyhow::{Context, bail};
use telemime_endpoint::HostClock;
use telemime_operator::cli::Event as Operator;
use telemime_operator::console::Shape;
use telemime_sim::link::{LinkConfig, Loss};
use tokio::sync::watch;

use super::Args;
use super::processes::{Called, start_robot};
use crate::process::{Process, watch_robot};
use crate::relay::{Relay, RelayConfig};

/// Serves until Ctrl-C.
pub(super) fn run(args: &Args, page: SocketAddr, scratch: &Path) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    runtime.block_on(serve(args, page, scratch))
}

async fn serve(args: &Args, page: SocketAddr, scratch: &Path) -> anyhow::Result<()> {
    let Called {
        mut robot,
        events: mut robot_events,
        addr,
        operator_args: who,
    } = start_robot(args, scratch, None).await?;
    let link = args.link.shape.config();
    let config = RelayConfig {
        listen: SocketAddr::from(([127, 0, 0, 1], 0)),
        to: addr,
        up: args.link.up(),
        down: args.link.down(),
        seed: args.link.shape.link_seed,
    };
    let (shapes, shapes_rx) = watch::channel(None);
    let relay = Relay::bind(config, HostClock::new())
        .context("no port for the relay")?
        .shaped_by(shapes_rx);
    let via = relay.local_addr()?;
    let (quit, quit_rx) = watch::channel(false);
    let relaying = tokio::spawn(relay.run(quit_rx, |_| {}));

    let mut operator_args = vec!["--connect".to_owned(), via.to_string()];
    operator_args.extend(who);
    let now = format!(
        "{},{},{}",
        args.link.shape.delay * 1e3,
        args.link.shape.jitter * 1e3,
        args.link.shape.loss * 1e2
    );
    operator_args.extend(["--console".to_owned(), page.to_string()]);
    operator_args.extend(["--console-link".to_owned(), now]);
    let mut operator = Process::start("operator", &operator_args)?;
    let mut operator_events: Vec<Operator> = Vec::new();
    let ended = tokio::select! {
        biased;
        _ = tokio::signal::ctrl_c() => Ok(()),
        end = watch_robot(&mut robot, &mut robot_events) => end,
        done = follow(&mut operator, args.json, |shape| {
            shapes.send_replace(Some(shaped(&link, shape)));
        }) => done,
    };
    // Whatever happened, nobody is left behind: first the hand, then the arm, then the link.
    let left = operator.finish(&mut operator_events).await;
    let stopped = robot.finish(&mut robot_events).await;
    quit.send_replace(true);
    relaying.await.context("the relay ended early")?;
    ended?;
    left?;
    stopped
}

fn shaped(link: &LinkConfig, shape: Shape) -> LinkConfig {
    LinkConfig {
        delay_s: shape.delay_ms * 1e-3,
        jitter_s: shape.jitter_ms * 1e-3,
        loss: Loss::random(shape.loss_percent * 1e-2),
        ..link.clone()
    }
}

/// Says what the operator says, and sets the link as the page wants it.
async fn follow(operator: &mut Process, json: bool, set: impl Fn(Shape)) -> anyhow::Result<()> {
    while let Some(event) = operator.next().await? {
        match event {
            Operator::LinkAsked(shape) => set(shape),
            Operator::Console { url } if json => {
                let line = serde_json::json!({ "event": "console", "url": url });
                say!("{line}");
            }
            Operator::Console { url } => say!(
                "open {url}\na simulated arm is there, across a link of your choice; Ctrl-C ends it"
            ),
            Operator::Note { text } => eprintln!("note: {text}"),
            Operator::State { state, cause, .. } if state == "Coasting" || state == "Holding" => {
                eprintln!("robot: {state} ({cause})");
            }
            _ => {}
        }
    }
    bail!("the operator ended by itself; it says why above")
}
