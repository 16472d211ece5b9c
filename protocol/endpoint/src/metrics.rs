//! Numbers for Prometheus: its text format (version 0.0.4), and a page that serves it from a thread of its own.

use std::fmt::{Display, Write};
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use axum::routing::get;

use crate::http::{self, Limits};
use crate::reception::{Quantiles, Received};

/// Scrapers at once; more wait.
const MAX_SCRAPERS: usize = 8;

/// A scraper's connection ends after this, whether it has read or not.
const STAY: Duration = Duration::from_secs(20);

/// The media type of the format.
const MEDIA_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// One page of metrics, as they are at one moment.
#[derive(Debug, Clone, Default)]
pub struct Page {
    prefix: &'static str,
    text: String,
}

/// A label's name and its value.
pub type Label<'a> = (&'static str, &'a str);

impl Page {
    /// A page whose metrics' names begin with `prefix`.
    pub fn new(prefix: &'static str) -> Self {
        Self {
            prefix,
            text: String::new(),
        }
    }

    /// The page in the text format.
    pub fn text(self) -> String {
        self.text
    }

    /// A value that goes up and down.
    pub fn gauge(&mut self, name: &str, help: &str, value: impl Display) {
        self.head(name, "gauge", help);
        self.sample(name, &[], value);
    }

    /// A count that only grows; its name ends with `_total`.
    pub fn counter(&mut self, name: &str, help: &str, value: impl Display) {
        self.head(name, "counter", help);
        self.sample(name, &[], value);
    }

    /// Several of one name, told apart by a label. `kind` is `gauge` or `counter`.
    pub fn each<V: Display>(
        &mut self,
        (name, kind): (&str, &'static str),
        help: &str,
        label: &'static str,
        values: impl IntoIterator<Item = (impl AsRef<str>, V)>,
    ) {
        self.head(name, kind, help);
        for (which, value) in values {
            self.sample(name, &[(label, which.as_ref())], value);
        }
    }

    /// The mean, the median, the 95th percentile and the largest of some times, s; nothing while there are none.
    pub fn times(&mut self, name: &str, help: &str, times: Option<Quantiles>) {
        let of = |t: Quantiles| {
            [
                ("mean", t.mean_s),
                ("p50", t.p50_s),
                ("p95", t.p95_s),
                ("max", t.max_s),
            ]
        };
        let values = times.map(of).into_iter().flatten();
        self.each((name, "gauge"), help, "stat", values);
    }

    /// What became of a session's flow of datagrams; names begin with `way`.
    pub fn flow(&mut self, way: &str, what: &str, flow: &Received) {
        let Received {
            received,
            lost,
            duplicates,
            reordered,
            longest_loss_run,
            jitter_s,
            delay,
            ..
        } = *flow;
        for (name, help, value) in [
            ("received", "arrived, each counted once", received),
            ("lost", "did not arrive, or not yet", lost),
            ("duplicates", "arrived once more", duplicates),
            ("reordered", "arrived after a later one", reordered),
            (
                "longest_loss_run",
                "were lost in a row at most",
                longest_loss_run,
            ),
        ] {
            let help = format!("In the present or last session, {what} that {help}.");
            self.gauge(&format!("{way}_{name}"), &help, value);
        }
        let help = format!("Interarrival jitter of {what} (RFC 3550), in seconds.");
        self.gauge(&format!("{way}_jitter_seconds"), &help, jitter_s);
        let help = format!(
            "One-way delay of {what} by the session clock, in seconds: of the present or last session."
        );
        self.times(&format!("{way}_delay_seconds"), &help, delay);
    }

    fn head(&mut self, name: &str, kind: &str, help: &str) {
        let prefix = self.prefix;
        let _ = writeln!(self.text, "# HELP {prefix}{name} {help}");
        let _ = writeln!(self.text, "# TYPE {prefix}{name} {kind}");
    }

    fn sample(&mut self, name: &str, labels: &[Label<'_>], value: impl Display) {
        let _ = write!(self.text, "{}{name}", self.prefix);
        for (i, (label, which)) in labels.iter().enumerate() {
            let which = which
                .replace('\\', r"\\")
                .replace('"', "\\\"")
                .replace('\n', r"\n");
            let open = if i == 0 { '{' } else { ',' };
            let _ = write!(self.text, "{open}{label}=\"{which}\"");
        }
        let close = if labels.is_empty() { "" } else { "}" };
        let _ = writeln!(self.text, "{close} {value}");
    }

    /// One sample with several labels.
    pub fn info(&mut self, name: &str, help: &str, labels: &[Label<'_>]) {
        self.head(name, "gauge", help);
        self.sample(name, labels, 1);
    }
}

/// Why there are no metrics.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The address cannot be had.
    #[error("cannot serve metrics at {addr}: {source}; choose another address with --metrics ADDR")]
    Bind {
        /// Where.
        addr: SocketAddr,
        /// The system's reason.
        source: io::Error,
    },
    /// No thread.
    #[error("cannot serve metrics: {0}")]
    System(#[from] io::Error),
}

/// Serves what `render` gives at `http://addr/metrics` until the process ends. Returns the address, its port chosen
/// where it was 0. Rendering happens on the server's thread.
///
/// # Errors
/// [`ServeError`].
pub fn serve(
    addr: SocketAddr,
    render: impl Fn() -> String + Send + Sync + 'static,
) -> Result<SocketAddr, ServeError> {
    let bind = |source| ServeError::Bind { addr, source };
    let listener = TcpListener::bind(addr).map_err(bind)?;
    listener.set_nonblocking(true)?;
    let at = listener.local_addr()?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let render = Arc::new(render);
    let page = move || {
        let text = render();
        async move { ([(header::CONTENT_TYPE, MEDIA_TYPE)], text) }
    };
    let elsewhere = || async {
        let text = "the metrics are at /metrics\n";
        (StatusCode::NOT_FOUND, text).into_response()
    };
    let router = Router::new()
        .route("/metrics", get(page))
        .fallback(elsewhere);
    std::thread::Builder::new()
        .name("metrics".into())
        .spawn(move || {
            runtime.block_on(async {
                if let Ok(listener) = tokio::net::TcpListener::from_std(listener) {
                    let limits = Limits {
                        connections: MAX_SCRAPERS,
                        request: STAY,
                        stay: STAY,
                    };
                    http::serve(listener, router, limits).await;
                }
            });
        })?;
    Ok(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_is_what_prometheus_reads() {
        let mut page = Page::new("x_");
        page.counter("stops_total", "Stops.", 3);
        page.each(
            ("state", "gauge"),
            "Which.",
            "state",
            [("a\"b\\c\nd", 1.0), ("e", 0.5)],
        );
        page.times("age_seconds", "Age.", None);
        page.info("info", "What.", &[("version", "1"), ("arm", "m")]);
        assert_eq!(
            page.text(),
            "# HELP x_stops_total Stops.\n# TYPE x_stops_total counter\nx_stops_total 3\n\
             # HELP x_state Which.\n# TYPE x_state gauge\nx_state{state=\"a\\\"b\\\\c\\nd\"} 1\nx_state{state=\"e\"} 0.5\n\
             # HELP x_age_seconds Age.\n# TYPE x_age_seconds gauge\n\
             # HELP x_info What.\n# TYPE x_info gauge\nx_info{version=\"1\",arm=\"m\"} 1\n"
        );
    }
}
