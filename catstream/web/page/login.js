// The address that `catstream view` prints ends with #TOKEN: what is behind # never leaves the browser by itself.
if (location.hash.length > 1) {
  document.querySelector("#token").value = location.hash.slice(1);
  history.replaceState(null, "", "/");
  document.querySelector("form").submit();
}
