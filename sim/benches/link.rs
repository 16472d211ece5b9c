//! Packets a second through a link: `cargo bench -p telemime-sim --bench link`.

use divan::Bencher;
use divan::counter::ItemsCount;
use telemime_sim::link::{Link, LinkConfig};

fn main() {
    divan::main();
}

const PACKETS: usize = 10_000;

#[divan::bench(args = [
    "delay 100ms",
    "delay 100ms 10ms loss 1%",
    "delay 100ms 10ms 25% distribution normal loss gemodel 1% 10% 70% 0.1%",
    "delay 100ms 10ms distribution pareto loss 1% duplicate 1% corrupt 1% reorder 25% 50% gap 5 rate 10mbit limit 1000",
    "delay 20ms rate 1mbit slot 10ms 20ms packets 32 outage 1s..2s every 5s",
])]
fn send(bencher: Bencher<'_, '_>, link: &str) {
    let config: LinkConfig = link.parse().expect("the benches' links are links");
    bencher
        .counter(ItemsCount::new(PACKETS))
        .with_inputs(|| Link::new(config.clone(), 1))
        .bench_values(|mut link| {
            (0..PACKETS as i64)
                .filter_map(|i| link.send(i * 1_000_000, 128).arrival_ns())
                .max()
        });
}
