//! Waits for a condition that another process or task brings about.

use std::time::Duration;

use anyhow::Context;
use tokio::time::{sleep, timeout};

/// How often the condition is checked.
const PERIOD: Duration = Duration::from_millis(20);

/// Waits until a condition holds, by checking every 20 ms.
///
/// # Errors
/// It does not hold within the timeout; the error names the `condition`.
pub async fn until(
    condition: &str,
    time_limit: Duration,
    mut holds: impl AsyncFnMut() -> bool,
) -> anyhow::Result<()> {
    let asked = async {
        while !holds().await {
            sleep(PERIOD).await;
        }
    };
    timeout(time_limit, asked)
        .await
        .with_context(|| format!("waited {time_limit:?} until {condition}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn it_waits_until_a_condition_holds_and_names_one_that_does_not() {
        let mut asked = 0;
        let third = async || {
            asked += 1;
            asked == 3
        };
        until("it was asked thrice", Duration::from_secs(60), third).await.unwrap();
        assert_eq!(asked, 3);
        let never = until("it rains", Duration::from_millis(1), async || false).await;
        assert_eq!(never.unwrap_err().to_string(), "waited 1ms until it rains");
    }
}
