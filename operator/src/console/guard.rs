//! Who may look and drive: against other sites in the same browser, and against strangers.
//!
//! A page of another site can make the browser send requests here, and a name of that site can be made to point here
//! (DNS rebinding). Such a request carries that site's `Origin`, or its name as `Host`. Beyond loopback there are
//! strangers too, and they lack the token.

use std::fmt;
use std::net::{IpAddr, SocketAddr};

use sha2::{Digest, Sha256};

/// What a request is judged by.
#[derive(Debug, Clone, Copy, Default)]
pub struct Request<'a> {
    /// Its `Host`.
    pub host: Option<&'a str>,
    /// Its `Origin`.
    pub origin: Option<&'a str>,
    /// Its cookies.
    pub cookies: Option<&'a str>,
    /// Its query.
    pub query: Option<&'a str>,
}

/// A request that is let in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// It is known.
    Known,
    /// It brought the token in its address: it gets a cookie, and the address is cleared.
    Token,
}

/// Why a request is turned away.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// `Host` is not ours.
    #[error("this console is not at `{0}`: open it by the address it printed")]
    Host(String),
    /// Another site's page asks.
    #[error("pages of `{0}` have no business here")]
    Origin(String),
    /// The token is missing or wrong.
    #[error("open the address with the token that the daemon printed when it started")]
    Token,
}

/// A secret for those who may drive.
#[derive(Clone)]
pub struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

impl Token {
    /// Of 16 random bytes.
    pub fn new(bytes: [u8; 16]) -> Self {
        Self(bytes.iter().map(|b| format!("{b:02x}")).collect())
    }

    /// As it stands in the address.
    pub fn text(&self) -> &str {
        &self.0
    }

    /// How long it takes says nothing of where they differ.
    fn is(&self, given: &str) -> bool {
        Sha256::digest(self.0.as_bytes()) == Sha256::digest(given.as_bytes())
    }
}

/// The rules of one console.
#[derive(Debug, Clone)]
pub struct Guard {
    listen: SocketAddr,
    token: Option<Token>,
}

impl Guard {
    /// For a console that listens there. Without a token only loopback makes sense.
    pub fn new(listen: SocketAddr, token: Option<Token>) -> Self {
        Self { listen, token }
    }

    /// The cookie that stands for the token; cookies do not tell ports apart, so its name does.
    pub fn cookie(&self) -> Option<String> {
        let token = self.token.as_ref()?;
        Some(format!("{}={}", self.cookie_name(), token.text()))
    }

    fn cookie_name(&self) -> String {
        format!("telemime-{}", self.listen.port())
    }

    /// Whether a request may come in.
    ///
    /// # Errors
    /// [`Refused`].
    pub fn judge(&self, request: &Request<'_>) -> Result<Pass, Refused> {
        let host = request.host.unwrap_or_default();
        if !self.is_ours(host) {
            return Err(Refused::Host(shortened(host)));
        }
        if let Some(origin) = request.origin
            && origin.strip_prefix("http://") != Some(host)
        {
            return Err(Refused::Origin(shortened(origin)));
        }
        let Some(token) = &self.token else {
            return Ok(Pass::Known);
        };
        let name = self.cookie_name();
        let cookies = request.cookies.unwrap_or_default().split(';');
        let cookie = cookies
            .filter_map(|cookie| cookie.trim().split_once('='))
            .find(|(key, _)| *key == name);
        if cookie.is_some_and(|(_, value)| token.is(value)) {
            return Ok(Pass::Known);
        }
        let given = request.query.unwrap_or_default();
        let given = given
            .split('&')
            .find_map(|pair| pair.strip_prefix("token="));
        if given.is_some_and(|given| token.is(given)) {
            return Ok(Pass::Token);
        }
        Err(Refused::Token)
    }

    /// Names can be made to point anywhere; addresses cannot. `localhost` is no site's name.
    fn is_ours(&self, host: &str) -> bool {
        let Some((name, port)) = host.rsplit_once(':') else {
            // Port 80 goes without saying.
            return self.listen.port() == 80 && self.is_named(host);
        };
        port.parse() == Ok(self.listen.port()) && self.is_named(name)
    }

    fn is_named(&self, name: &str) -> bool {
        let bare = name.strip_prefix('[').and_then(|n| n.strip_suffix(']'));
        let ip = bare.unwrap_or(name).parse::<IpAddr>();
        let loopback = ip.as_ref().map_or(name == "localhost", IpAddr::is_loopback);
        if self.listen.ip().is_loopback() {
            loopback
        } else {
            loopback || ip.is_ok()
        }
    }
}

fn shortened(text: &str) -> String {
    text.chars().filter(|c| !c.is_control()).take(80).collect()
}
